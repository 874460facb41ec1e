"""The simulated vehicles and their links, room by room."""
