"""Random numbers of the vehicles. Each use has its own stream, so more draws for one use leave the others unchanged."""

from enum import IntEnum, unique

import numpy as np


@unique
class Use(IntEnum):
    """Uses of random numbers. The value is the last word of the spawn key of the use's stream."""

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
    """The seed sequence of one stream of a scenario; system id 0 stands for streams common to all vehicles."""
    return np.random.SeedSequence(seed, spawn_key=(system_id, use))


def draws_of(seed: int, system_id: int, use: Use) -> np.random.Generator:
    return np.random.default_rng(seeds_of(seed, system_id, use))
