"""The scenario's limits, applied to every set-point that is sent, whatever computed it."""

from dataclasses import dataclass
from math import hypot
from typing import Any

from scenarios.schema import Limits

LARGEST_COMMAND_M_S2 = 9_999.0
"""The limit if the scenario sets none: a larger command is a fault, not a manoeuvre. Vehicles refuse more than 1e4,
which rounding to float32 must not reach."""

Vector = tuple[float, float]
_VELOCITY, _ACCELERATION = slice(4, 6), slice(7, 9)
"""North and east among the fields of SET_POSITION_TARGET_LOCAL_NED."""


@dataclass(frozen=True)
class SetPointLimits:
    """Largest horizontal acceleration and speed that a set-point may ask for."""

    acceleration_m_s2: float
    speed_m_s: float

    @classmethod
    def of(cls, limits: Limits) -> "SetPointLimits":
        return cls(limits.acceleration_max_m_s2 or LARGEST_COMMAND_M_S2, limits.speed_max_m_s or LARGEST_COMMAND_M_S2)

    def command(self, wanted_m_s2: Vector) -> Vector:
        """A wanted acceleration, shortened to the limit in its own direction; the same object if it is within."""
        return _shortened(wanted_m_s2, self.acceleration_m_s2)

    def set_point(self, fields: tuple[Any, ...]) -> tuple[Any, ...]:
        """The fields of a set-point, velocity and acceleration within the limits; the same object if they were."""
        wanted_m_s, wanted_m_s2 = fields[_VELOCITY], fields[_ACCELERATION]
        velocity_m_s, acceleration_m_s2 = _shortened(wanted_m_s, self.speed_m_s), self.command(wanted_m_s2)
        if velocity_m_s is wanted_m_s and acceleration_m_s2 is wanted_m_s2:
            return fields
        return (*fields[:4], *velocity_m_s, fields[6], *acceleration_m_s2, *fields[9:])


def _shortened(vector: Any, longest: float) -> Vector:
    north, east = vector
    size = hypot(north, east)
    return (north * longest / size, east * longest / size) if size > longest else vector
