"""Random numbers of the vehicles. Each use has a stream of its own, so that drawing more for one changes no other."""

from enum import IntEnum, unique

import numpy as np


@unique
class Use(IntEnum):
    """What random numbers are drawn for: the last word of the spawn key of their stream."""

    CLOCK = 0
    LINK_UP = 1
    LINK_DOWN = 2
    SENSOR = 4
    ORIGIN = 7
    GUSTS = 8
    NAVIGATION = 9
    BACKDATING = 10
    SLIPS = 11


def seeds_of(seed: int, system_id: int, use: Use) -> np.random.SeedSequence:
    """The seeds of one stream of a scenario; those common to all vehicles have system id 0."""
    return np.random.SeedSequence(seed, spawn_key=(system_id, use))


def draws_of(seed: int, system_id: int, use: Use) -> np.random.Generator:
    return np.random.default_rng(seeds_of(seed, system_id, use))
