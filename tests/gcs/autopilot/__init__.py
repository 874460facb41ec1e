"""Start-up of vehicles with autopilots, and the identification of their response."""
