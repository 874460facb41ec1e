"""Simulated vehicles: one MAVLink shell, and the crafts it carries: double integrators and multicopters.

A double integrator may have a loop on board; a multicopter behaves like ArduCopter or PX4.
"""
