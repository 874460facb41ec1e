"""The limits of an autopilot, read from its parameters, within which its commands are kept.

A command beyond these limits is not followed. The loop is then no longer the one whose margin is known: it limit-cycles
or overshoots. A vehicle far from its place is therefore led along a braking curve instead of by the linear law.
"""

from collections.abc import Sequence
from math import hypot, inf, isfinite, sqrt
from typing import Any

from gcs.autopilot.kinds import ARDUCOPTER, PX4_COPTER
from gcs.link import mavlink
from gcs.link.kinds import Kind
from gcs.plan.flight_plan import FlightPlan, own_gains
from scenarios.kernel import Records
from scenarios.schema import NS_PER_S

ACCELERATION_M_S2, JERK_M_S3 = 2.0, 4.0
"""Bounds for a vehicle that does not report its own limits."""
_ACCELERATION_SHARE, _JERK_SHARE = 0.9, 0.8
"""Usable fractions of the reported limits: the velocity loop adds to the command."""
_BRAKING_SHARE = 0.3
"""Fraction of the acceleration limit assumed by the braking curve: the jerk limit and the response take the rest."""
_PARAMETERS = {
    ARDUCOPTER.name: (("WPNAV_ACCEL", 0.01), ("PSC_JERK_XY", 1.0), ("GUID_TIMEOUT", 1.0)),
    PX4_COPTER.name: (("MPC_ACC_HOR", 1.0), ("MPC_JERK_AUTO", 1.0), ("COM_OF_LOSS_T", 1.0)),
}
"""Parameters of each kind for acceleration, jerk and set-point timeout, with their units in m/s^2, m/s^3 and s."""
_LEAST, _LARGEST = 0.1, 100.0
"""Range of plausible limits in those units; a value outside is ignored."""
_ATTEMPTS, _PATIENCE_NS = 3, NS_PER_S


class ReportedLimits:
    """Reads the limits of one vehicle from its parameters."""

    def __init__(self) -> None:
        self._reported: list[float | None] = [None] * 3
        """Acceleration, jerk and set-point timeout; None while not reported."""
        self._kind = ""
        self._asked: dict[str, int] = {}
        self._not_before_ns = 0

    def next(self, kind: Kind, now_ns: int, *, target_system: int, rtt_ns: int) -> tuple[int, tuple[Any, ...]] | None:
        """Message id and fields of the request that is due, if any: one at a time, `_ATTEMPTS` for each parameter."""
        if now_ns < self._not_before_ns or kind.name not in _PARAMETERS:
            return None
        self._kind = kind.name
        for (name, _), known in zip(_PARAMETERS[kind.name], self._reported, strict=True):
            if known is None and self._asked.get(name, 0) < _ATTEMPTS:
                self._asked[name] = self._asked.get(name, 0) + 1
                self._not_before_ns = now_ns + max(_PATIENCE_NS, 3 * rtt_ns)
                return mavlink.PARAM_REQUEST_READ, mavlink.param_request_read(name, target_system=target_system)
        return None

    def take(self, fields: tuple[Any, ...]) -> None:
        """Process a PARAM_VALUE; an implausible value is ignored."""
        value, _, _, field, _ = fields
        name = field.partition(b"\0")[0].decode("ascii", "replace")
        if name not in self._asked:
            return
        at = [known for known, _ in _PARAMETERS[self._kind]].index(name)
        limit = value * _PARAMETERS[self._kind][at][1]
        if _LEAST <= limit <= _LARGEST:
            self._not_before_ns, self._reported[at] = 0, round(limit, 6)

    @property
    def acceleration_bound_m_s2(self) -> float:
        reported = self._reported[0]
        return ACCELERATION_M_S2 if reported is None else _ACCELERATION_SHARE * reported

    @property
    def jerk_bound_m_s3(self) -> float:
        """The largest rate of change of the acceleration."""
        reported = self._reported[1]
        return JERK_M_S3 if reported is None else _JERK_SHARE * reported

    def in_words(self) -> str:
        reported = [
            f"{name} {value:g} {unit}"
            for (name, _), value, unit in zip(
                _PARAMETERS.get(self._kind, ()), self._reported, ("m/s^2", "m/s^3", "s"), strict=False
            )
            if value is not None
        ]
        source = ", ".join(reported) if reported else "it reports no limits"
        return f"set-points within {self.acceleration_bound_m_s2:g} m/s^2 and {self.jerk_bound_m_s3:g} m/s^3: {source}"


class Bounds:
    """Keeps the commands of a formation within the limits of each vehicle."""

    def __init__(self, plan: FlightPlan, limits: Sequence[ReportedLimits]) -> None:
        self._limits = limits
        self._most_m_s2 = plan.scenario.limits.acceleration_max_m_s2 or inf
        self._period_s = 1.0 / plan.scenario.rates.control_hz
        self._gains = [own_gains(plan, K) for K in plan.gains]
        self._last = [(0.0, 0.0)] * len(limits)
        self._approaches = [True] * len(limits)
        """Whether a vehicle is still approaching its place. Once there, the linear law applies: beyond the margin, the
        braking curve would turn growing errors into a limit cycle and hide that the loop is unstable."""

    def acceleration_m_s2(self, row: int) -> float:
        """The largest acceleration that may be commanded to a vehicle."""
        return min(self._most_m_s2, self._limits[row].acceleration_bound_m_s2)

    def rest(self, row: int) -> None:
        """Note that the vehicle gets no command; its next command starts from zero."""
        self._last[row], self._approaches[row] = (0.0, 0.0), True

    def bound(self, controls: Records, blends: Records) -> None:
        """Keep commands within the limits of acceleration and jerk, and approaching vehicles on the braking curve."""
        flown = blends["flown"].tolist()
        commands = controls["command_m_s2"].tolist()
        for row, spacing_error in enumerate(controls["spacing_error_m"].tolist()):
            if isfinite(commands[row][0]) and isfinite(commands[row][1]):
                commands[row] = self._bounded(row, commands[row], spacing_error, flown[row])
        controls["command_m_s2"] = commands

    def _bounded(
        self, row: int, command_m_s2: Sequence[float], spacing_error_m: Sequence[float], flown: int
    ) -> tuple[float, float]:
        limit = self.acceleration_m_s2(row)
        less_north, less_east = self._braking(row, spacing_error_m, flown, _BRAKING_SHARE * limit)
        north, east = command_m_s2[0] - less_north, command_m_s2[1] - less_east
        if (over := hypot(north, east) / limit) > 1.0:
            north, east = north / over, east / over
        (was_north, was_east), jerk = self._last[row], self._limits[row].jerk_bound_m_s3
        far = hypot(north - was_north, east - was_east) / (jerk * self._period_s)
        if far > 1.0:
            north, east = was_north + (north - was_north) / far, was_east + (east - was_east) / far
        self._last[row] = north, east
        return north, east

    def _braking(
        self, row: int, spacing_error_m: Sequence[float], flown: int, braking_m_s2: float
    ) -> tuple[float, float]:
        """The excess of the linear law's acceleration far from the vehicle's place, which is to be subtracted.

        Under the law an error e closes at the speed lambda e, lambda = k3 / k1. Beyond e_0 = b / lambda^2 that would
        need braking harder than b; the speed there is sqrt(2 b (e - e_0 / 2)) instead.
        """
        error_north, error_east = spacing_error_m
        error_m = hypot(error_north, error_east)
        gains = self._gains[flown]
        if gains is None or not error_m > 0.0:  # NaN for the leader
            return 0.0, 0.0
        k1, k3 = gains[row]
        if not (k1 > 0.0 and k3 > 0.0):
            return 0.0, 0.0
        rate = k3 / k1
        linear_m = braking_m_s2 / rate**2
        self._approaches[row] &= error_m > linear_m
        if not self._approaches[row]:
            return 0.0, 0.0
        counted_m = sqrt(2.0 * braking_m_s2 * (error_m - linear_m / 2.0)) / rate
        less = k3 * (1.0 - counted_m / error_m)
        return less * error_north, less * error_east
