"""The user's own control law: its arguments, and the design and plan of a scenario that names one.

A law is a function `law(t_s, states, formation, memory)` that returns the acceleration of each vehicle, (N, 2) in m/s²
north and east. `states` are (N, 4), position and velocity north and east, all at the same time, in the order of
`formation.system_ids`; the row of a lost vehicle is NaN. `memory` is a dict, empty at the first call of a flight, and
the only state that a law may keep. For the rest see docs/how-to/own-law.md.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from gcs.errors import InputError
from gcs.plan.design import CodeRecord, Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.formation import Formation, plan_formation
from gcs.plan.given import gain_blocks
from scenarios.keys.own import BUILT_IN
from scenarios.own_code import code_names, function_of
from scenarios.schema import Scenario

OWN_LAW = "law without control.linear; measure it with gcs stress --onset"
OWN_DYNAMICS = "dynamics without [response], which gcs identify finds; or measure it with gcs stress --onset"
TOLERANCE = 1e-6
"""Largest difference between a law and its matrices, relative to the largest entry of K."""
_STEP = 1e-3
"""Step (m, m/s) of the differences that linearise a law."""
_CALLS = 3
"""Number of successive calls in which a linear law must give the same answer to the same errors."""
_SIZES = 1.0, -1.0, 50.0
"""The law must agree with its matrices at these sizes (m, m/s) of each error: near its place and far from it."""


@dataclass(frozen=True, eq=False)
class LawFormation:
    """The formation as a law sees it: N vehicles, each listed after the one it follows."""

    system_ids: tuple[int, ...]
    predecessors: tuple[int, ...]
    """For each vehicle, the row of the one in front; -1 for the leader, which is row 0."""
    offset_ne_m: FloatArray
    """(N, 2): wanted position relative to the vehicle in front, north and east; zero for the leader."""
    nominal_velocity_ne_m_s: FloatArray
    """(2,): v_d at this time."""
    period_s: float
    """Control period: the law is called once in each."""

    @cached_property
    def model(self) -> FormationModel:
        """The error model, which names the order of the errors e in u = K e."""
        return FormationModel(self.predecessors)

    def spacing_error_m(self, states: FloatArray) -> FloatArray:
        """(N, 2): e_i^p = position in front - own position + offset; zero for the leader."""
        front = list(self.predecessors[1:])
        error = np.zeros((len(states), 2))
        error[1:] = states[front, :2] - states[1:, :2] + self.offset_ne_m[1:]
        return error

    def velocity_error_m_s(self, states: FloatArray) -> FloatArray:
        """(N, 2): e_i^v = own velocity - v_d."""
        return states[:, 2:] - self.nominal_velocity_ne_m_s

    def errors(self, states: FloatArray) -> FloatArray:
        """(4 N - 2,): e in the order of `model`: the leader's e^v, then e^p and e^v of each other vehicle."""
        both = np.hstack([self.spacing_error_m(states), self.velocity_error_m_s(states)])
        return both.ravel()[2:]

    def states(self, errors: FloatArray) -> FloatArray:
        """(N, 4): states with these errors, the leader at the origin."""
        e = np.concatenate([np.zeros(2), errors]).reshape(-1, 4)
        states = np.zeros((len(e), 4))
        states[:, 2:] = e[:, 2:] + self.nominal_velocity_ne_m_s
        for i, ahead in enumerate(self.predecessors):
            if ahead >= 0:
                states[i, :2] = states[ahead, :2] + self.offset_ne_m[i] - e[i, :2]
        return states


Law = Callable[[float, FloatArray, LawFormation, dict[str, Any]], ArrayLike]
"""A control law; see the docstring of this module."""


def law_formation(
    formation: Formation, velocity_ne_m_s: tuple[float, float], period_s: float, opening: float = 1.0
) -> LawFormation:
    """The formation as an argument of a law, at a nominal velocity; `opening` scales the spacing."""
    offset_ne_m, velocity = opening * formation.offset_ne_m, np.array(velocity_ne_m_s)
    for array in (offset_ne_m, velocity):
        array.flags.writeable = False  # a law may keep state only in its memory
    return LawFormation(formation.system_ids, tuple(formation.model.predecessors), offset_ne_m, velocity, period_s)


def law_of(scenario: Scenario) -> Law | None:
    """Run the file of the law that a scenario names, and return the law; None if it names none."""
    return None if scenario.control.controller is None else function_of(scenario, "control.controller")


def accelerations(answer: object, vehicles: int) -> FloatArray:
    """The answer of a law as (N, 2). Raises ValueError for another shape or type; numbers may be NaN or infinite."""
    found = np.asarray(answer)
    if found.shape != (vehicles, 2) or found.dtype.kind not in "fiu":
        shape = f"shape {found.shape}" if found.dtype.kind in "fiu" else f"{type(answer).__name__}"
        raise ValueError(f"returned {shape}, wanted ({vehicles}, 2) numbers")
    return found.astype(np.float64)


def own_plan(
    scenario: Scenario, given_plan: Callable[[Scenario], tuple[Design, FlightPlan]]
) -> tuple[Design, FlightPlan]:
    """Design and plan of a scenario whose controller is code; `given_plan` does this for given gain blocks.

    A law with a stated K (`control.linear`) has the margin of K, after a check that the two agree. Any other is flown
    with an unknown margin. The gain of its plan is the law linearised at zero error; only the search for the onset uses
    it, to see which vehicles are coupled.
    """
    law, formation = law_of(scenario), plan_formation(scenario)
    assert law is not None
    known = law_formation(formation, scenario.nominal_velocity_at(0.0), 1.0 / scenario.rates.control_hz)
    given = None if scenario.control.linear is None else _given_gain(scenario, known)
    if given is None:
        gain = _linearised(law, known)
        plan = FlightPlan(scenario, formation, gain, nan, separable=False, law=law)
        design = Design(
            delay_margin_s=None,
            method="python",
            period_s=plan.timing.held_s,
            vehicles=len(formation.system_ids),
            margin_unknown=OWN_LAW,
            code=code_records(scenario),
        )
        return design, plan
    _check(scenario, law, given, known)
    control = {"method": "inclusion", "controller": None, "linear": None, "blocks": gain_blocks(given, formation)}
    monitor = {"time_scales": (1.0,)}  # a law cannot be slowed down
    design, plan = given_plan(scenario.with_keys(control=control, monitor=monitor))
    design = design.model_copy(update={"method": "python", "code": code_records(scenario)})
    return design, replace(plan, scenario=scenario, law=law, around_loss=())


def with_unknown_margin(design: Design, plan: FlightPlan, why: str) -> tuple[Design, FlightPlan]:
    """Design and plan without margins, and without figures that hold only for vehicles that respond at once."""
    none = {"delay_margin_s": None, "delay_margin_continuous_s": None}
    schedule = tuple(
        entry.model_copy(update=none | {"alpha": None, "decay_rate_1_s": None}) for entry in design.schedule
    )
    kept = {"K1_1_s", "K2_1_s", "K3_1_s2", "K", "links", "period_s", "vehicles", "method", "loop", "pattern", "blocks"}
    kept |= {"feed_forward", "requirement", "for_link"}
    known = Design(
        **{name: getattr(design, name) for name in kept & design.model_fields_set},
        delay_margin_s=None,
        schedule=schedule,
        margin_unknown=why,
        code=code_records(plan.scenario),
    )
    slower = tuple((gain, nan) for gain, _ in plan.slower)
    return known, replace(plan, delay_margin_s=nan, slower=slower)


def why_unknown(plan: FlightPlan) -> str:
    """Why the margin of a plan is unknown; empty if it is known."""
    if not isnan(plan.delay_margin_s):
        return ""
    return OWN_LAW if plan.scenario.dynamics in BUILT_IN else OWN_DYNAMICS


def code_records(scenario: Scenario) -> tuple[CodeRecord, ...]:
    """The published records of a scenario's code files, named as in the folder of a run."""
    return tuple(CodeRecord(file=Path(code.name).name, sha256=code.sha256) for code in scenario.code)


def code_by_key(scenario: Scenario) -> dict[str, CodeRecord]:
    """The code file that each key names, by the key and its value: "control.controller = my_law.py:law"."""
    known = {code.name: code.sha256 for code in scenario.code}
    named = {f"{key} = {name}": name.rpartition(":")[0] for key, name in code_names(scenario).items()}
    return {text: CodeRecord(file=path, sha256=known[path]) for text, path in named.items()}


def _given_gain(scenario: Scenario, formation: LawFormation) -> FloatArray:
    name, model = scenario.control.linear, formation.model
    wanted = f"a finite matrix K of u = K e, {model.inputs} x {model.states}, for these {model.vehicles} vehicles"
    matrices = function_of(scenario, "control.linear")
    try:
        K = np.asarray(matrices(formation), dtype=np.float64)
    except Exception as error:
        raise InputError(f"control.linear: {name} raised {type(error).__name__}: {error}; wanted {wanted}") from error
    if K.shape != (model.inputs, model.states) or not np.isfinite(K).all():
        read = f"one of shape {K.shape}" if K.shape != (model.inputs, model.states) else "numbers that are not finite"
        raise InputError(f"control.linear: {name}: read {read}, wanted {wanted}")
    return K


def _check(scenario: Scenario, law: Law, K: FloatArray, formation: LawFormation) -> None:
    """Refuse a law unless it equals u = K e at zero error and at small and large errors of each kind, in every call."""
    scale = float(np.abs(K).max())
    for size in (0.0, *_SIZES):
        for k in range(K.shape[1] if size else 1):
            e = np.zeros(K.shape[1])
            e[k] = size
            states, memory, wanted = formation.states(e), dict[str, Any](), (K @ e).reshape(-1, 2)
            for call in range(_CALLS):
                try:
                    found = accelerations(law(call * formation.period_s, states.copy(), formation, memory), len(states))
                except Exception as error:
                    raise _refused(scenario, f"{type(error).__name__}: {error}") from error
                off = float(np.abs(found - wanted).max(initial=0.0))
                if not off <= TOLERANCE * max(1.0, abs(size)) * max(scale, 1.0):
                    at = "without errors" if not size else f"for error {k + 1} of {K.shape[1]} at {size:g}"
                    raise _refused(scenario, f"{off:.3g} m/s² apart {at}")


def _refused(scenario: Scenario, read: str) -> InputError:
    control = scenario.control
    wanted = f"the same accelerations within {TOLERANCE:g} of the largest gain, or no control.linear"
    return InputError(f"control.linear: {control.controller} against {control.linear}: read {read}; wanted {wanted}")


def _linearised(law: Law, formation: LawFormation) -> FloatArray:
    """K of the law for small errors, by central differences; zero where it has no derivative or fails."""
    model = formation.model
    K = np.zeros((model.inputs, model.states))

    def answer(e: FloatArray) -> FloatArray:
        return accelerations(law(0.0, formation.states(e), formation, {}), model.vehicles).ravel()

    for k in range(model.states):
        e = np.zeros(model.states)
        e[k] = _STEP
        try:
            column = (answer(e) - answer(-e)) / (2.0 * _STEP)
        except Exception:  # noqa: BLE001 - whatever the user's law raises; the flight counts it
            continue
        K[:, k] = np.where(np.isfinite(column), column, 0.0)
    # round away the noise of the differences, which would couple all vehicles and make equal ones differ
    scale = TOLERANCE * float(np.abs(K).max(initial=0.0))
    return scale * np.round(K / scale) if scale else K
