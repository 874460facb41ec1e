"""The scenario's limits, applied to every set-point that is sent, whatever computed it."""

from dataclasses import dataclass

from gains.core.arrays import FloatArray
from scenarios.hypot import hypot
from scenarios.kernel import Array, Records, kernel
from scenarios.schema import Limits

LARGEST_COMMAND_M_S2 = 9_999.0
"""The limit if the scenario sets none: a larger command is a fault, not a manoeuvre. Vehicles refuse more than 1e4,
which rounding to float32 must not reach."""


@dataclass(frozen=True)
class SetPointLimits:
    """Largest horizontal acceleration and speed that a set-point may ask for."""

    acceleration_m_s2: float
    speed_m_s: float

    @classmethod
    def of(cls, limits: Limits) -> "SetPointLimits":
        return cls(limits.acceleration_max_m_s2 or LARGEST_COMMAND_M_S2, limits.speed_max_m_s or LARGEST_COMMAND_M_S2)

    def limit_commands(self, commands_m_s2: FloatArray) -> None:
        """Shorten accelerations (n, 2) to the limit, each in its own direction."""
        shorten(commands_m_s2, self.acceleration_m_s2)

    def limit(self, points: Records) -> None:
        """Shorten the velocities and accelerations of set-points (n, SET_POINT) to the limits."""
        shorten(points["velocity_ned_m_s"], self.speed_m_s)
        shorten(points["acceleration_ne_m_s2"], self.acceleration_m_s2)


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
