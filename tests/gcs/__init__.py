"""The ground station, room by room."""
