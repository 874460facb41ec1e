"""Flights and fleets that test modules share."""
