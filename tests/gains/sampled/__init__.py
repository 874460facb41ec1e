"""Loops as they are flown: sampled, held, at two rates, predicted or on board."""
