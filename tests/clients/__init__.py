"""Clients of other makers against the simulated vehicles: MAVSDK, signed and unsigned, and MAVProxy."""
