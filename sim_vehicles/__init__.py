"""Simulated UAVs behind emulated links, as MAVLink systems of their own. Begin at `drive.fleet`."""
