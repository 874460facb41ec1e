"""Set-points for vehicles with autopilots: a velocity, its acceleration, and a climb rate that keeps the altitude.

The control law commands accelerations; an autopilot tracks velocities. So each vehicle has a velocity target, the
integral of its commanded accelerations, and is sent both.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

from gcs.autopilot.startup import AutopilotStartup

_CLIMB_GAIN_1_S = 0.5
_CLIMB_MAX_M_S = 1.0
_Vector = tuple[float, float]
VelocitySetPoint = tuple[tuple[float, float, float], tuple[float, float]]
"""Velocity (north, east, down) and acceleration (north, east)."""


@dataclass
class _Target:
    velocity_m_s: _Vector
    acceleration_m_s2: _Vector
    since_ns: int


class VelocityTargets:
    def __init__(self, starts: Sequence[AutopilotStartup], *, period_s: float) -> None:
        self._starts = starts
        self._targets: list[_Target | None] = [None] * len(starts)
        self._period_s = period_s

    def hover(self, row: int) -> VelocitySetPoint:
        """The set-point with which a vehicle hovers: no horizontal velocity."""
        self._targets[row] = None
        return self._with_climb(row, (0.0, 0.0), (0.0, 0.0))

    def rest(self, row: int) -> None:
        """Record that no set-point is sent: the next one starts from the vehicle's velocity."""
        self._targets[row] = None

    def steers(self, row: int) -> bool:
        return self._targets[row] is not None

    def accelerate(
        self, row: int, acceleration_m_s2: _Vector, velocity_m_s: _Vector, *, lead_m_s: float, now_ns: int
    ) -> VelocitySetPoint:
        """The set-point for a commanded acceleration.

        `velocity_m_s` is the vehicle's newest velocity; it may be NaN if the vehicle already has a velocity target. The
        target is kept within `lead_m_s` of it.
        """
        target = self._targets[row]
        if target is None:
            north, east = velocity_m_s
        else:
            since_s = (now_ns - target.since_ns) * 1e-9
            north = target.velocity_m_s[0] + target.acceleration_m_s2[0] * since_s
            east = target.velocity_m_s[1] + target.acceleration_m_s2[1] * since_s
            own_north, own_east = velocity_m_s
            ahead_m_s = hypot(north - own_north, east - own_east)
            if ahead_m_s > lead_m_s:  # it cannot follow: a larger lead would only wind up
                share = lead_m_s / ahead_m_s
                north, east = own_north + share * (north - own_north), own_east + share * (east - own_east)
        self._targets[row] = _Target((north, east), acceleration_m_s2, now_ns)
        # A vehicle that holds the velocity between set-points is sent the velocity at the middle of the period.
        ahead_s = 0.0 if self._starts[row].kind.velocity_grows else self._period_s / 2.0
        sent = north + ahead_s * acceleration_m_s2[0], east + ahead_s * acceleration_m_s2[1]
        return self._with_climb(row, sent, acceleration_m_s2)

    def _with_climb(self, row: int, velocity_m_s: _Vector, acceleration_m_s2: _Vector) -> VelocitySetPoint:
        startup = self._starts[row]
        missing_m = startup.altitude_m - (startup.relative_altitude_m or 0.0)
        climb_m_s = max(-_CLIMB_MAX_M_S, min(_CLIMB_MAX_M_S, _CLIMB_GAIN_1_S * missing_m))
        return (*velocity_m_s, -climb_m_s), acceleration_m_s2
