"""ArduPilot and PX4: the start of their flights, identification of their response, their pilots."""
