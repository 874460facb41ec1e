"""The user's own control law in flight: called once per tick, timed, and never trusted.

The law gets the states of all vehicles at one instant, that of the oldest among their newest states: nothing is
extrapolated, and the loop delay counts from that instant. If it raises an exception or returns a wrong shape, NaN or
infinity, each vehicle concerned is sent zero acceleration and holds its velocity. After `BAD_IN_A_ROW` consecutive
calls of this kind, the flight ends and the vehicles hold.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from math import isfinite, nan
from typing import Any

import numpy as np

from gains.core.arrays import FloatArray
from gcs.control.history import Reports
from gcs.control.law import FeedbackLaw, Vector, feedback_law
from gcs.control.loops import Loop, TickInputs
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.own_law import LawFormation, accelerations, law_formation
from scenarios.kernel import Records

BUDGET_SHARE = 0.2
"""Share of the control period that a call of a law may take."""
BAD_IN_A_ROW = 25
"""This many calls in a row without a usable command for every vehicle end the flight."""
LAW = "law"
"""Kind of the events about a law: its first bad call, and its counts at the end."""
CALLS, BAD, OVER = "calls", "bad", "over budget"
_HOLD = 0.0, 0.0


class FlownLaw:
    """The user's law in one flight, with its memory and the counts of its calls.

    `report` records an event: kind, text, no system id, counts. `stop` ends the flight for the reason given.
    `clock_ns` measures the duration of calls; None in virtual time, where nothing may depend on the machine.
    """

    def __init__(
        self,
        plan: FlightPlan,
        report: Callable[[str, str, None, dict[str, int] | None], None],
        stop: Callable[[str], None],
        clock_ns: Callable[[], int] | None = None,
    ) -> None:
        assert plan.law is not None
        self._law, self._report, self._stop, self._clock_ns = plan.law, report, stop, clock_ns
        self._budget_ns = round(BUDGET_SHARE * plan.timing.step_s * 1e9)
        self._memory: dict[str, Any] = {}
        self._counts = Counter({CALLS: 0, BAD: 0} | ({} if clock_ns is None else {OVER: 0}))
        self._bad_in_a_row = 0

    def commands(self, t_s: float, states: FloatArray, formation: LawFormation) -> list[Vector]:
        """The acceleration of each vehicle; zero where the law's is unusable. The states of lost vehicles are NaN."""
        lost: list[bool] = np.isnan(states[:, 0]).tolist()
        clock_ns, fault = self._clock_ns, ""
        began_ns = 0 if clock_ns is None else clock_ns()
        try:
            found = self._called(t_s, states, formation)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever the user's law raises
            found, fault = [(nan, nan)] * len(states), f"{type(error).__name__}: {error}"
        if clock_ns is not None and clock_ns() - began_ns > self._budget_ns:
            self._counts[OVER] += 1
        bad = [row for row, command in enumerate(found) if not lost[row] and not _is_usable(command)]
        self._counts[CALLS] += 1
        self._judge(bad, fault or f"returned {found[bad[0]] if bad else ''}", formation)
        return [command if _is_usable(command) else _HOLD for command in found]

    def report(self) -> None:
        """Record the counts as an event, at the end of the flight."""
        texts = (f"{count} {name}" for name, count in self._counts.items())
        self._report(LAW, ", ".join(texts), None, dict(self._counts))

    def _called(self, t_s: float, states: FloatArray, formation: LawFormation) -> list[Vector]:
        with np.errstate(all="ignore"):  # results that are not finite are counted instead
            answer = self._law(t_s, states, formation, self._memory)
        return [(north, east) for north, east in accelerations(answer, len(states)).tolist()]

    def _judge(self, bad: Sequence[int], fault: str, formation: LawFormation) -> None:
        if not bad:
            self._bad_in_a_row = 0
            return
        self._bad_in_a_row += 1
        self._counts[BAD] += 1
        ids = " ".join(str(formation.system_ids[row]) for row in bad[:8])
        what = " ".join(f"{fault}, vehicle{'s' * (len(bad) > 1)} {ids}".split())[:200]
        if self._counts[BAD] == 1:
            self._report(LAW, f"no usable command: {what}", None, None)
        if self._bad_in_a_row == BAD_IN_A_ROW:
            self._stop(f"law failed: {BAD_IN_A_ROW} calls in a row without a usable command, the last: {what}")


class OwnLawLoop(Loop):
    """The ground loop with commands from the user's own law."""

    def __init__(self, plan: FlightPlan, law: FlownLaw) -> None:
        super().__init__(plan)
        self._law = law
        self._formation_at = lru_cache(maxsize=1)(partial(law_formation, plan.formation, period_s=plan.timing.step_s))

    def law(self, lost: Sequence[bool], returning: Sequence[bool] | None = None) -> FeedbackLaw:
        """The law with zero gains, which still gives the spacing errors and marks the lost vehicles."""
        return feedback_law(self._plan.formation, (np.zeros_like(self._plan.gain),), lost, returning)

    def control(self, history: Reports, law: FeedbackLaw, blends: Records, now: TickInputs) -> Records:
        controls = super().control(history, law, blends, now)
        flown = law.flown
        instant_ns = controls["sample_ns"][flown].min().item() if flown.any() else 0
        if now.time_s < 0.0 or instant_ns == 0:  # before the flight, or a vehicle has reported nothing
            controls["command_m_s2"] = nan
            return controls
        states = np.full((len(flown), 4), nan)
        states[flown] = history.every_at(np.flatnonzero(flown), np.full(flown.sum(), instant_ns))
        formation = self._formation_at(now.nominal_velocity_m_s, opening=now.opening)
        commands = np.array(self._law.commands(now.time_s, states, formation))
        controls["command_m_s2"][flown], controls["used_ns"][flown] = commands[flown], instant_ns
        return controls


def _is_usable(command: Vector) -> bool:
    north, east = command
    return isfinite(north) and isfinite(east)
