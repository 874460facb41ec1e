"""Loops as flown: sampled and held, at two rates, or with a loop on board. Begin at `constant`."""
