"""Whole flights of simulated ArduCopters and PX4s, with their pilots and their limits."""
