"""Simulated UAVs behind emulated links; each is a MAVLink system. Begin at `drive.fleet`."""
