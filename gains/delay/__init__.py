"""Delay margins of continuous loops with constant delays."""
