"""The free response of one loop through random links, against its linear model through the same delays."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import expm

from gains.core.arrays import FloatArray
from gains.sampled.coupled_block import CoupledBlock
from gains.sampled.multirate import effective_delay_s
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.loops import plan_loops
from gcs.runs.grade import ACTED, SAMPLED, commands_of
from gcs.stress.axes import at_coordinates
from gcs.stress.free_response import FreeResponse, fly_calm, in_place, response_paired
from gcs.stress.growth import CHANNELS
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from scenarios.keys.disturbance import Disturbance, Gusts, Navigation
from scenarios.keys.link import Link, VehicleLinks
from scenarios.schema import Limits
from tests.support.fleets.stress_pair import SCENARIO, pair_plan
from tests.support.truth import instants

PERIOD_S = 0.02


def plan_with(**coordinates: float) -> FlightPlan:
    return replace(pair_plan(), scenario=at_coordinates(SCENARIO, coordinates))


def modelled(loop: CoupledBlock, response: FreeResponse, before: FloatArray) -> FloatArray:
    """The loop's errors at the samples of the response's rows, integrated from command to command.

    x' = A x + B u exactly, u = K x(sampled) from the instant at which each command acted, u = 0 before the first.
    """
    truth = response.flight.truth
    assert truth is not None
    commands = commands_of(response.errors, truth, loop.system_ids[0])
    sampled_ns = {
        int(row["key"]): int(row["time_ns"])
        for row in truth
        if row["kind"] == 1 and row["system_id"] == loop.system_ids[0]
    }
    wanted_ns = [sampled_ns[boot_ms] for boot_ms in response.errors["sample_boot_ms"].tolist()]
    acts = dict(commands.tolist())
    x, u, at = before, np.zeros(loop.B.shape[1]), dict[int, FloatArray]()
    generator = np.zeros((len(x) + len(u),) * 2)
    generator[: len(x)] = np.hstack([loop.A, loop.B])
    last_ns: int | None = None
    for now_ns in sorted({*acts, *acts.values(), *wanted_ns}):
        if last_ns is not None:
            step = expm(generator * (now_ns - last_ns) * 1e-9).astype(np.float64)
            x = (step @ np.concatenate([x, u]))[: len(x)]
        at[now_ns] = x
        if now_ns in acts:
            u = loop.K @ at[acts[now_ns]]
        last_ns = now_ns
    return np.array([at[time_ns] for time_ns in wanted_ns])


@pytest.mark.parametrize(
    "coordinates",
    [{"delay": 0.15, "jitter": 0.03}, {"delay": 0.15, "loss": 0.4}, {"delay": 0.25, "jitter": 0.01, "loss": 0.2}],
)
def test_a_loop_on_random_links_follows_its_linear_model(coordinates: dict[str, float]) -> None:
    """Two independent ways agree to the last digits of telemetry, though the links push the vehicles by metres."""
    plan = plan_with(**coordinates)
    [_, follower] = plan_loops(plan)
    calm = fly_calm(plan, None)
    response = response_paired(plan, calm, (2,), amplitude=1.0, folder=None)
    flown = np.stack([response.errors[name] for name in CHANNELS], axis=1)
    early = response.errors["time_s"] < 5.0
    model = modelled(follower, response, before=np.array([-1.0, 0.8, 0.0, 0.0]))
    assert np.abs(flown).max() > 1.0
    assert flown[early] == pytest.approx(model[early], abs=2e-3)
    pushed = calm.ticks[(calm.ticks["system_id"] == 2) & calm.ticks["commanded"]]
    assert np.nanmax(np.abs(pushed["spacing_error_north_m"])) > 0.1


class Reported:
    """Reported states of one vehicle along one axis, as the station knows them at some time."""

    def __init__(self) -> None:
        self.time_s: list[float] = []
        self.position_m: list[float] = []
        self.velocity_m_s: list[float] = []

    def at(self, time_s: float, newest_s: float) -> tuple[float, float]:
        """Between two reports a cubic for position and a line for velocity; after the newest, constant velocity."""
        k = int(np.searchsorted(self.time_s, newest_s - 1e-9))
        if time_s >= newest_s:
            return self.position_m[k] + self.velocity_m_s[k] * (time_s - newest_s), self.velocity_m_s[k]
        k = int(np.searchsorted(self.time_s, time_s, side="right"))
        pair = slice(k - 1, k + 1)
        cubic = CubicHermiteSpline(self.time_s[pair], self.position_m[pair], self.velocity_m_s[pair])
        return float(cubic(time_s)), float(np.interp(time_s, self.time_s[pair], self.velocity_m_s[pair]))


def test_a_coupled_loop_on_unequal_links_follows_its_linear_model() -> None:
    """The leader uses the follower's spacing, which arrives 60 ms later than its own: the station extrapolates it.

    The model has absolute positions along one axis, and the instants at which states were sampled and commands acted. A
    model with one delay per command, which takes all states at the instant of the vehicle's own, is less exact.
    """
    plan = pair_plan()
    gain = plan.gain.copy()
    gain[0, 2] = gain[1, 3] = -1.5
    slow, fast = Link(delay_s=0.08), Link(delay_s=0.02)
    own = (VehicleLinks(system_id=1, up=fast, down=fast), VehicleLinks(system_id=2, up=slow, down=slow))
    links = SCENARIO.links.model_copy(update={"vehicles": own})
    plan = replace(plan, gain=gain, scenario=SCENARIO.model_copy(update={"links": links}))
    response = response_paired(plan, fly_calm(plan, None), (1, 2), amplitude=1.0, folder=None)
    truth, rows = response.flight.truth, response.errors
    assert truth is not None
    sampled = {key: ns * 1e-9 for key, ns in instants(truth, SAMPLED).items()}
    acted = {key: ns * 1e-9 for key, ns in instants(truth, ACTED).items()}
    used_s = {
        (int(row["tick"]), int(row["system_id"])): sampled[int(row["system_id"]), int(row["sample_boot_ms"])]
        for row in rows
    }
    acts = [
        (acted[int(row["system_id"]), int(row["key_ms"])], 1, row)
        for row in rows
        if (int(row["system_id"]), int(row["key_ms"])) in acted
    ]
    samples = [(time_s, 0, system_id) for (system_id, _), time_s in sampled.items()]
    events: list[tuple[float, int, Any]] = sorted([*acts, *samples], key=lambda event: event[:2])
    reports = {1: Reported(), 2: Reported()}
    # the leader starts with 1 m/s too much, the follower 1.3 m behind its place
    x, v, u, now_s = np.array([0.0, -1.3]), np.array([1.0, 0.0]), np.zeros(2), acts[0][0]
    gain_axis, off = gain[::2, ::2], list[float]()
    for time_s, kind, what in events:
        step_s = max(0.0, time_s - now_s)
        x, v, now_s = x + v * step_s + u * step_s**2 / 2.0, v + u * step_s, max(now_s, time_s)
        if kind == 0:
            one = reports[what]
            one.time_s.append(time_s)
            one.position_m.append(float(x[what - 1]))
            one.velocity_m_s.append(float(v[what - 1]))
            continue
        tick, system_id = int(what["tick"]), int(what["system_id"])
        at_s = used_s[tick, system_id]
        (p1, v1), (p2, v2) = (reports[k].at(at_s, used_s[tick, k]) for k in (1, 2))
        u[system_id - 1] = (gain_axis @ np.array([v1, p1 - p2, v2]))[system_id - 1]
        off.append(what["velocity_error_north_m_s"] - (v1, v2)[system_id - 1])
        if system_id == 2:
            off.append(what["spacing_error_north_m"] - (p1 - p2))
    assert np.abs(off).max() < 1e-3  # 0.06 m without extrapolation
    assert np.abs(rows["velocity_error_north_m_s"]).max() > 1.0


def test_effective_delay_of_regular_commands_is_their_loop_delay() -> None:
    acted_ns = 1_000_000_000 + 20_000_000 * np.arange(50, dtype=np.int64)
    commands = np.stack([acted_ns, acted_ns - 130_000_000], axis=1)
    assert effective_delay_s(commands, held_s=PERIOD_S) == pytest.approx(0.130, abs=1e-12)


def test_losing_every_second_command_adds_half_a_period() -> None:
    acted_ns = 1_000_000_000 + 40_000_000 * np.arange(50, dtype=np.int64)
    commands = np.stack([acted_ns, acted_ns - 130_000_000], axis=1)
    assert effective_delay_s(commands, held_s=PERIOD_S) == pytest.approx(0.140, abs=1e-12)


def test_without_commands_the_effective_delay_is_zero() -> None:
    assert effective_delay_s(np.empty((0, 2), dtype=np.int64), held_s=PERIOD_S) == 0.0


@pytest.mark.slow(first=1)
@pytest.mark.parametrize(
    "coordinates", [{"delay": 0.15, "jitter": 0.02, "loss": 0.05}, {"delay": 0.15, "loss": 0.05}, {"delay": 0.15}]
)
def test_a_probe_measures_the_loop_whatever_limits_the_vehicles_have(coordinates: dict[str, float]) -> None:
    """Jitter alone pushes the vehicles past 2 m/s², and a flight that is cut off there is no free response."""
    limits = Limits(speed_min_m_s=55.0, speed_max_m_s=65.0, acceleration_max_m_s2=2.0, turn_rate_max_rad_s=0.1)
    limited = replace(pair_plan(), scenario=SCENARIO.model_copy(update={"limits": limits}))
    one, other = (fly_trial(Study(plan).trial("probe", coordinates, seed=7)) for plan in (limited, pair_plan()))
    assert one.growth_1_s is not None
    assert (one.growth_1_s, one.loop_delay_s) == (other.growth_1_s, other.loop_delay_s)
    assert (one.past_limits, other.past_limits) == ("jitter" in coordinates, False)


def test_the_effective_delay_predicts_loss_the_median_does_not() -> None:
    """A third of the datagrams is lost each way. The median of the loop delays ignores commands that never arrived.

    The effective delay is right to first order in the variation, here to 0.05 1/s; the median is off by 0.2.
    """
    study = Study(pair_plan())
    outcome = fly_trial(study.trial("probe", {"delay": 0.15, "loss": 0.33}, seed=7))
    without = fly_trial(study.trial("probe", {"delay": 0.15}, seed=7))
    assert outcome.growth_1_s is not None
    assert outcome.predicted_growth_1_s is not None
    assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=0.05)
    assert without.growth_1_s is not None
    assert outcome.growth_1_s - without.growth_1_s > 0.2


def test_on_random_links_a_probe_lasts_equally_many_loop_delays() -> None:
    """Its rate is a mean over the delays drawn: 20 s at a margin of 1.5 s left it wrong by the whole curve's range."""

    def duration_s(margin_s: float, **coordinates: float) -> float:
        plan = replace(plan_with(**coordinates), delay_margin_s=margin_s)
        return in_place(plan, (1,), amplitude=1e-3).duration_s

    assert duration_s(0.3, jitter=0.02) == 20.0
    assert duration_s(1.5, jitter=0.02) == duration_s(1.5, loss=0.03) == 99.0
    assert duration_s(30.0, jitter=0.02) == 120.0
    assert duration_s(1.5) == duration_s(np.inf, jitter=0.02) == 20.0


def test_wind_gusts_and_navigation_errors_leave_growth_as_it_is() -> None:
    """A probe shows a free response; with them, the onset of a scenario was found at 0.4 times its margin."""
    pushes = {
        "disturbance": Disturbance(wind_ne_m_s2=(0.2, -0.1), gusts=Gusts(deviation_m_s2=0.3, correlation_time_s=2.0)),
        "navigation": Navigation(position_noise_m=0.3, velocity_noise_m_s=0.1),
    }
    calm = Study(pair_plan()).trial("probe", {"delay": 0.2}, seed=1)
    pushed = replace(calm, scenario=calm.scenario.model_copy(update=pushes))
    assert fly_trial(pushed).growth_1_s == fly_trial(calm).growth_1_s
