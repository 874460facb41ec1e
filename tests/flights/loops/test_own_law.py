"""Formations flown with a user's own control law or dynamics."""

import numpy as np
import pytest

from gcs import VirtualFlight, fly_virtual
from gcs.control.own_law import BAD_IN_A_ROW, BUDGET_SHARE, FlownLaw
from gcs.errors import InputError
from gcs.plan.own_law import OWN_DYNAMICS, OWN_LAW, LawFormation, law_formation
from gcs.plan.planner import flight_plan
from gcs.station.journal import Journal
from scenarios.keys.course import ChangedOffset, FormationChange
from scenarios.schema import Response
from tests.support.fleets.own_code import LAW, coded, given

ROUNDING_M = 1e-9
"""Positions are single precision: at these distances, different ones differ by 4e-6 m or more."""

REMEMBERS = "memory['n'] = memory.get('n', 1) + 1; return command * memory['n'] / 2"


@pytest.fixture(scope="module")
def built_in() -> VirtualFlight:
    return fly_virtual(given())


def apart_m(one: VirtualFlight, two: VirtualFlight) -> float:
    return float(np.nanmax(np.abs(one.position_ne_m - two.position_ne_m)))


def test_the_law_of_the_gains_flies_as_the_gains_do(built_in: VirtualFlight) -> None:
    flight = fly_virtual(coded(law="linear"), allow_code=True)
    assert apart_m(flight, built_in) <= ROUNDING_M
    assert np.nanmax(np.abs(flight.command_ne_m_s2 - built_in.command_ne_m_s2)) < 1e-9  # sums in another order
    assert np.array_equal(flight.loop_delay_s, built_in.loop_delay_s, equal_nan=True)
    assert flight.design.margin_unknown == flight.summary.margin_unknown == OWN_LAW
    assert flight.summary.delay_margin_s is flight.summary.headroom_min is None
    assert flight.summary.law is not None
    assert flight.summary.law.to_dict() == {"calls": 80, "unusable": 0, "over_budget": None, "budget_s": 0.01}


def test_a_law_manoeuvres_as_its_gains_do() -> None:
    change = FormationChange(at_s=1.0, duration_s=2.0, offsets=(ChangedOffset(system_id=2, offset_ne_m=(-60.0, 40.0)),))
    flown = [
        fly_virtual(scenario, allow_code=True)
        for scenario in (given(formation_changes=(change,)), coded(law="linear", formation_changes=(change,)))
    ]
    assert apart_m(*flown) <= ROUNDING_M


def test_a_linear_law_has_the_margin_of_its_gains(built_in: VirtualFlight) -> None:
    design, plan = flight_plan(coded(law="linear", linear="matrices"))
    assert design.delay_margin_s == pytest.approx(
        built_in.design.delay_margin_s, rel=1e-9
    )  # the same loop, found twice
    assert plan.delay_margin_s == design.delay_margin_s
    assert (design.method, design.margin_unknown, len(plan.gains)) == ("python", "", 1)
    flight = fly_virtual(coded(law="linear", linear="matrices"), allow_code=True)
    assert flight.summary.headroom_min == built_in.summary.headroom_min


@pytest.mark.parametrize(
    ("text", "law", "wanted"),
    [
        (LAW, "soft", "m/s² apart for error 1 of 6 at 1"),
        (LAW.replace("np.tanh(", "1.0 * ("), "soft", None),
        (LAW.replace("return command", "return command + 1e-3"), "linear", "0.001 m/s² apart without errors"),
        (LAW.replace("return command", REMEMBERS), "linear", "m/s² apart for error 1 of 6 at 1"),
        (LAW.replace("return command", "return command[0]"), "linear", r"ValueError: returned shape \(2,\)"),
        (LAW.replace("return formation", "return 0.0 * formation"), "linear", "apart for error 1"),
        (LAW.replace("np.eye(2) for gain", "np.eye(3) for gain"), "linear", "control.linear: own.py:matrices raised"),
    ],
)  # fmt: skip
def test_matrices_that_are_not_the_law_are_refused(text: str, law: str, wanted: str | None) -> None:
    scenario = coded(text, law=law, linear="matrices")
    if wanted is None:
        assert flight_plan(scenario)[0].delay_margin_s is not None
        return
    with pytest.raises(InputError, match=wanted) as refused:
        flight_plan(scenario)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "answer",
    ["np.full((2, 2), np.nan)", "[[np.inf, 0.0], [0.0, 0.0]]", "np.zeros((3, 2))", "None", "'ab'", "1 / 0", "exit()"],
)
def test_bad_answers_are_held_counted_and_end_the_flight(answer: str) -> None:
    answered = f"return {answer} if t_s >= 1.0 else linear(t_s, *rest)"
    text = f"{LAW}\ndef bad(t_s, *rest):\n    {answered}\n"
    flight = fly_virtual(coded(text, law="bad"), allow_code=True)
    assert (flight.summary.verdict, flight.summary.law is not None) == ("aborted", True)
    assert flight.summary.reason.startswith(f"law failed: {BAD_IN_A_ROW} calls in a row without a usable command")
    assert sum(event.text.startswith("no usable command") for event in flight.events) == 1
    bad = (flight.time_s >= 1.0) & np.isfinite(flight.command_ne_m_s2[:, 0, 0])
    held = np.abs(flight.command_ne_m_s2[bad]).max(axis=(0, 2))
    assert np.isfinite(flight.command_ne_m_s2[bad]).all()
    assert held[0] == 0.0 or answer.startswith("[[")
    assert flight.summary.law is not None
    assert BAD_IN_A_ROW <= flight.summary.law.unusable <= BAD_IN_A_ROW + 1
    assert flight.summary.duration_s == pytest.approx(1.0 + BAD_IN_A_ROW / 20.0, abs=0.1)  # of 4 s


def test_a_law_that_fails_now_and_then_flies_on() -> None:
    text = (
        LAW + "\ndef rare(t_s, *rest):\n    return np.nan * rest[0][:, :2] if t_s % 1.0 < 0.1 else linear(t_s, *rest)\n"
    )
    flight = fly_virtual(coded(text, law="rare"), allow_code=True)
    assert flight.summary.reason.startswith("completed")
    assert flight.summary.law is not None
    assert flight.summary.law.unusable == 8  # two of the twenty calls of each second


def test_calls_over_their_budget_are_counted_by_the_clock_given() -> None:
    plan, events = flight_plan(coded(law="linear"))[1], list[tuple[object, ...]]()
    known = law_formation(plan.formation, (60.0, 0.0), 0.05)
    budget_ns = round(BUDGET_SHARE * 0.05e9)
    times_ns = iter([0, budget_ns, 0, budget_ns + 1, 0, 5 * budget_ns])

    def report(kind: str, text: str, system_id: None, counts: dict[str, int] | None) -> None:
        events.append((kind, text, system_id, counts))

    law = FlownLaw(plan, report, list[str]().append, lambda: next(times_ns))
    for tick in range(3):
        law.commands(0.05 * tick, known.states(np.zeros(6)), known)
    law.report()
    assert events == [("law", "3 calls, 0 bad, 2 over budget", None, {"calls": 3, "bad": 0, "over budget": 2})]


def test_lost_vehicles_need_no_command() -> None:
    plan, reasons = flight_plan(coded(law="linear"))[1], list[str]()
    known = law_formation(plan.formation, (60.0, 0.0), 0.05)
    law, states = FlownLaw(plan, Journal(0, 0.0).report, reasons.append), known.states(np.zeros(6))
    states[1] = np.nan
    for _ in range(2 * BAD_IN_A_ROW):
        assert law.commands(0.0, states, known)[0] == (0.0, 0.0)
    assert reasons == []
    states[:] = known.states(np.zeros(6))
    states[0] = np.nan  # whom the other follows
    for _ in range(BAD_IN_A_ROW):
        law.commands(0.0, states, known)
    assert len(reasons) == 1


def test_errors_and_states_are_each_others_inverse() -> None:
    formation = LawFormation(
        (1, 2, 3, 4), (-1, 0, 0, 2), np.array([[0, 0], [-5, 1], [-5, -1], [-9, 9]]), np.ones(2), 0.1
    )
    e = np.random.default_rng(3).standard_normal(14)
    states = formation.states(e) + np.array([1e3, -1e3, 0.0, 0.0])
    assert formation.errors(states) == pytest.approx(e, abs=1e-12)  # rounding of 1e3
    A, x_later = formation.model.A, states + np.hstack([states[:, 2:], np.zeros((4, 2))])
    assert formation.errors(x_later) - formation.errors(states) == pytest.approx(A @ e, abs=1e-12)


def test_dynamics_of_a_double_integrator_fly_as_the_built_in(built_in: VirtualFlight) -> None:
    flight = fly_virtual(coded(dynamics="step"), allow_code=True)
    assert apart_m(flight, built_in) <= 1e-5  # a few of the last digits: it adds the same numbers in another order
    assert flight.design.margin_unknown == OWN_DYNAMICS
    assert flight.summary.delay_margin_s is flight.summary.at_loop_delay.alpha is None


def test_own_dynamics_with_a_response_have_its_margin(built_in: VirtualFlight) -> None:
    design, _ = flight_plan(coded(dynamics="lagged", response=Response(lag_s=0.1)))
    assert design.delay_margin_s is not None
    assert built_in.design.delay_margin_s is not None
    assert 0.0 < design.delay_margin_s < built_in.design.delay_margin_s
    assert design.margin_unknown == ""


@pytest.mark.parametrize(
    "answer", ["np.full(4, np.nan)", "state * np.inf", "state[:3]", "None", "1 / 0", "state + 1e9"]
)
def test_steps_that_cannot_be_used_keep_the_velocity(answer: str) -> None:
    text = f"{LAW}\ndef bad(state, command, dt_s, memory):\n    return {answer}\n"
    flight = fly_virtual(coded(text, dynamics="bad", duration_s=2.0), allow_code=True)
    assert np.nanmax(np.abs(flight.velocity_ne_m_s - [60.0, 0.0])) < 1e-9
    told = [event.text for event in flight.events if event.text.startswith("dynamics: ")]
    assert len(told) == 2  # once by each vehicle


def test_python_runs_code_only_where_it_is_allowed() -> None:
    with pytest.raises(InputError, match=r"pair: control.controller: read 'own.py:soft', wanted --allow-code"):
        fly_virtual(coded("raise SystemExit", law="soft"))
