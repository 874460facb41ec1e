"""Simulated vehicles: one MAVLink system (`shell`), and what flies in it: double integrators and multicopters.

A double integrator may close a loop on board (`onboard`); a multicopter behaves like ArduCopter or PX4
(`copter_rules`).
"""
