"""Flights in virtual time: their fast path, and what is compiled before them."""
