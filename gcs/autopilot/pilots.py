"""Set-points for vehicles with autopilots: a velocity, the acceleration that goes with it, and a climb to hold height.

The control law wants accelerations; an autopilot holds velocities. So each vehicle has a velocity target that is the
integral of what was wanted of it, and both are sent.
"""

from dataclasses import dataclass
from math import hypot
from typing import Any

from gcs.link import mavlink
from gcs.link.vehicle import RemoteVehicle

_CLIMB_GAIN_1_S = 0.5
_CLIMB_MAX_M_S = 1.0
_RESET_M_S = 5.0
"""A velocity target this far from the vehicle's velocity has lost it; it begins anew there."""


@dataclass
class _Target:
    velocity_m_s: tuple[float, float]
    acceleration_m_s2: tuple[float, float]
    since_ns: int


class Pilots:
    """The velocity targets of all vehicles."""

    def __init__(self, vehicles: int, *, period_s: float) -> None:
        self._targets: list[_Target | None] = [None] * vehicles
        self._period_s = period_s

    def hover(self, row: int, vehicle: RemoteVehicle, *, key_ms: int) -> tuple[Any, ...]:
        """The set-point that keeps a vehicle where it is."""
        self._targets[row] = None
        return self._fields(vehicle, key_ms, (0.0, 0.0), (0.0, 0.0))

    def rest(self, row: int) -> None:
        """No set-point is sent: the next one begins at the vehicle's velocity."""
        self._targets[row] = None

    def steers(self, row: int) -> bool:
        """Whether a vehicle has a velocity target to go on from."""
        return self._targets[row] is not None

    def accelerate(
        self,
        row: int,
        vehicle: RemoteVehicle,
        acceleration_m_s2: tuple[float, float],
        velocity_m_s: tuple[float, float],
        *,
        key_ms: int,
        now_ns: int,
    ) -> tuple[Any, ...]:
        """The set-point of a wanted acceleration.

        `velocity_m_s` is the vehicle's newest; it may be NaN if the vehicle is steered already.
        """
        target = self._targets[row]
        if target is None:
            north, east = velocity_m_s
        else:
            since_s = (now_ns - target.since_ns) * 1e-9
            north = target.velocity_m_s[0] + target.acceleration_m_s2[0] * since_s
            east = target.velocity_m_s[1] + target.acceleration_m_s2[1] * since_s
            if hypot(north - velocity_m_s[0], east - velocity_m_s[1]) > _RESET_M_S:
                north, east = velocity_m_s
        self._targets[row] = _Target((north, east), acceleration_m_s2, now_ns)
        kind = vehicle.kind
        # One that holds the velocity between set-points gets that of the middle of the period.
        ahead_s = 0.0 if kind.velocity_grows else self._period_s / 2.0
        sent = north + ahead_s * acceleration_m_s2[0], east + ahead_s * acceleration_m_s2[1]
        return self._fields(vehicle, key_ms, sent, acceleration_m_s2)

    def _fields(
        self,
        vehicle: RemoteVehicle,
        key_ms: int,
        velocity_m_s: tuple[float, float],
        acceleration_m_s2: tuple[float, float],
    ) -> tuple[Any, ...]:
        startup = vehicle.startup
        assert startup is not None
        missing_m = startup.altitude_m - (startup.relative_altitude_m or 0.0)
        climb_m_s = max(-_CLIMB_MAX_M_S, min(_CLIMB_MAX_M_S, _CLIMB_GAIN_1_S * missing_m))
        return mavlink.velocity_set_point(
            key_ms=key_ms,
            target_system=vehicle.system_id,
            velocity_ned_m_s=(*velocity_m_s, -climb_m_s),
            acceleration_ne_m_s2=acceleration_m_s2,
        )
