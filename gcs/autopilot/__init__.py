"""What vehicles with an autopilot of their own need: start-up, one frame, their response found and flown with."""
