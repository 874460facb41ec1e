"""Checks before a flight, and flights in virtual time."""
