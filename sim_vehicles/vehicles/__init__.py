"""Simulated vehicles: a MAVLink system (`shell`) with a craft in it, a double integrator or a multicopter.

A double integrator may close a loop on board (`onboard`); a multicopter behaves like ArduCopter or PX4
(`copter_rules`).
"""
