"""The scenario's limits, applied to every set-point that is sent, whatever computed it."""

from scenarios.hypot import hypot
from scenarios.kernel import Array, kernel

LARGEST_COMMAND_M_S2 = 9_999.0
"""The limit if the scenario sets none: a larger command is a fault, not a manoeuvre. Vehicles refuse more than 1e4,
which rounding to float32 must not reach."""


@kernel
def shorten(vectors: Array, longest: float) -> None:
    """Shorten the horizontal parts of vectors (n, 2 or 3) to a length, each in its own direction."""
    for row in range(len(vectors)):
        north, east = vectors[row, 0], vectors[row, 1]
        size = hypot(north, east)
        if size > longest:
            vectors[row, 0], vectors[row, 1] = north * longest / size, east * longest / size


@kernel
def any_beyond(vectors: Array, largest: float) -> bool:
    """Whether a component of a vector is larger than so much."""
    beyond = False
    for row in range(len(vectors)):
        beyond |= abs(vectors[row, 0]) > largest or abs(vectors[row, 1]) > largest
    return beyond
