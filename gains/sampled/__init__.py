"""Delay margins of loops as flown: sampled and held, at several rates, or with a local loop on board."""
