"""Vehicles with ArduPilot or PX4: start-up, identification of their response, set-points. Begin at `fleet`."""
