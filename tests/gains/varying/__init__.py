"""Bounds for delays that vary in time."""
