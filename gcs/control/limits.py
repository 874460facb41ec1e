"""The scenario's limits, applied to every set-point sent, whatever computed it."""

from scenarios.hypot import hypot
from scenarios.kernel import Array, kernel

LARGEST_COMMAND_M_S2 = 9_999.0
"""The limit if the scenario sets none: a larger command is a fault, not a manoeuvre. Vehicles refuse more than 1e4, a
value that rounding to float32 must not reach."""


@kernel
def shorten(vectors: Array, longest: float) -> None:
    """Limit the horizontal parts of vectors (n, 2 or 3) to a length; directions are kept."""
    for row in range(len(vectors)):
        north, east = vectors[row, 0], vectors[row, 1]
        size = hypot(north, east) if abs(north) + abs(east) > longest else 0.0
        if size > longest:
            vectors[row, 0], vectors[row, 1] = north * longest / size, east * longest / size


@kernel
def any_beyond(vectors: Array, largest: float) -> bool:
    """Whether the magnitude of any horizontal component exceeds `largest`."""
    beyond = False
    for row in range(len(vectors)):
        beyond |= abs(vectors[row, 0]) > largest or abs(vectors[row, 1]) > largest
    return beyond
