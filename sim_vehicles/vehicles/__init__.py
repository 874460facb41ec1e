"""Simulated vehicles: one MAVLink shell, and the crafts in it (double integrator, multicopter, own loop)."""
