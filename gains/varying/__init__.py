"""Bounds that hold for delays that vary in time."""
