"""Third-party clients fly the simulated vehicles: MAVSDK, signed and unsigned, and MAVProxy."""
