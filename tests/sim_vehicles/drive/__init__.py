"""The fleet in virtual time, and the links in front of vehicles that are somebody else's."""
