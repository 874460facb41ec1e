"""Whole flights in virtual time: station, links and vehicles together."""
