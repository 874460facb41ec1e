"""Flights of a station that predicts: they decay or grow as the certificate says, and settle where others break."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gains.criteria.predicted import PredictedFigures
from gains.design.predicted import least_gains, longest_assumed_s
from gains.performance.scalar_gains import PAIR, ScalarGains
from gains.sampled.multirate import Timing
from gains.sampled.prediction import predicted_growth_rate
from gcs.control.tick import TickArray
from gcs.drive.flown import fly_plan
from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from gcs.stress.axes import at_coordinates
from gcs.stress.free_response import probe_scenario
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from scenarios.files import load
from scenarios.keys.link import DelayPoint, Jitter, Link, Links
from scenarios.left_out import without
from scenarios.schema import Control, FixedGains, Limits, NominalVelocity, Scenario, Vehicle
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.motion.double_integrator import State
from tests.support.known import known
from tests.support.paths import SCENARIOS

TRIANGLE = load(SCENARIOS / "triangle5.toml")
GAINS = FixedGains(K1=-3.408, K2=0.631, K3=5.608)
DECAY_1_S = 1.735
"""Decay rate of these gains without delay. Prediction keeps it at every delay: docs/explanation/prediction.md."""


def scenario(prediction: float | str, *, link_s: float, **changes: object) -> Scenario:
    control = Control.model_validate({"gains": GAINS, "prediction": prediction})
    return at_coordinates(TRIANGLE.model_copy(update={"control": control, **changes}), {"delay": link_s})


@cache
def planned(prediction: float | str) -> FlightPlan:
    return flight_plan(scenario(prediction, link_s=0.0).with_calm_monitor())[1]


def errors_m(ticks: TickArray, *, from_s: float) -> float:
    """The largest spacing error from a time on."""
    rows = ticks[ticks["time_s"] >= from_s]
    return float(np.nanmax(np.hypot(rows["spacing_error_north_m"], rows["spacing_error_east_m"])))


@pytest.mark.slow(first=3)
@pytest.mark.parametrize(
    ("assumed_s", "loop_s"),
    [
        (0.3, 0.35),
        (0.6, 0.4569),  # beside the lower end of its window, with parts of a period in both delays
        (0.6, 0.64),
        (0.6131, 0.7513),
        (1.5, 1.45),
        (1.5, 1.5817),
        (1.5, 1.6),  # beyond the window: errors grow
    ],
)
def test_errors_change_at_the_rate_of_the_certificate(assumed_s: float, loop_s: float) -> None:
    """The flown arithmetic is that of `predicted_map`: any other would have other roots."""
    trial = Study(planned(assumed_s)).trial("probe", {"delay": loop_s - 0.01}, seed=1)
    outcome = fly_trial(trial)
    growth, predicted = known(outcome.growth_1_s), known(outcome.predicted_growth_1_s)
    # telemetry is rounded to float32: 0.1 mm, to which an error of a metre decays in a few seconds
    assert growth == pytest.approx(predicted, abs=0.01 + 0.01 * abs(predicted))
    tolerated = planned(assumed_s).tolerance(assumed_s)
    mismatch_s = known(outcome.loop_delay_s) - assumed_s
    assert (growth < 0.0) == (-tolerated.shorter_s[0] < mismatch_s < tolerated.longer_s[0])


def test_without_mismatch_errors_decay_as_without_delay() -> None:
    """At 1.5 s of loop delay, five times the margin of these gains."""
    beside = fly_trial(Study(planned(1.5)).trial("probe", {"delay": 1.49}, seed=1, probe=2))
    link_s = 1.49 + 1.5 - known(beside.loop_delay_s)
    outcome = fly_trial(Study(planned(1.5)).trial("probe", {"delay": link_s}, seed=1, probe=2))
    assert outcome.loop_delay_s == pytest.approx(1.5, abs=1e-4)
    assert known(outcome.growth_1_s) == pytest.approx(-DECAY_1_S, rel=0.02)


@cache
def least_assumed() -> tuple[ScalarGains, float]:
    """The least gains that decay as fast, and the longest delay at which their prediction tolerates a 5 % mismatch."""
    k1, k3 = least_gains(DECAY_1_S, 0.02)
    gains = ScalarGains(k1, 0.2 * k1, k3, 0.0)
    return gains, longest_assumed_s(gains, 0.02, 0.05, 10.0)


def least_planned(*left_out: int) -> FlightPlan:
    gains, assumed_s = least_assumed()
    given = FixedGains(K1=-gains.k1, K2=gains.k2, K3=gains.k3)
    control = Control.model_validate({"gains": given, "prediction": assumed_s})
    flown = TRIANGLE.model_copy(update={"control": control}).with_calm_monitor()
    return flight_plan(without(flown, left_out, SCENARIOS / "triangle5.toml"))[1]


def test_least_gains_decay_as_fast_at_their_longest_delay() -> None:
    """2.16 s, 6.6 times what any static gains take at this decay. A mismatch of 0.1 ms would split the double root."""
    study, assumed_s = Study(least_planned()), least_assumed()[1]
    beside = fly_trial(study.trial("probe", {"delay": assumed_s - 0.01}, seed=1, probe=2))
    link_s = 2.0 * assumed_s - 0.01 - known(beside.loop_delay_s)
    outcome = fly_trial(study.trial("probe", {"delay": link_s}, seed=1, probe=2))
    assert outcome.loop_delay_s == pytest.approx(assumed_s, abs=1e-6)
    assert known(outcome.growth_1_s) == pytest.approx(-DECAY_1_S, rel=0.02)


@pytest.mark.slow(first=2)
@pytest.mark.parametrize("mismatch", [-0.0475, 0.0475, 0.06])
def test_least_gains_take_a_delay_that_is_5_percent_wrong(mismatch: float) -> None:
    """A leader and its follower for 40 s: near the limit many modes are slow, and only time separates them."""
    gains, assumed_s = least_assumed()
    plan, loop_s, waiting_s = least_planned(3, 4, 5), (1.0 + mismatch) * assumed_s, 0.01
    link = Link(delay_s=(loop_s - waiting_s) / 2.0)
    probe = probe_scenario(plan, (2,), amplitude=1.0, links=(link, link), waiting_s=waiting_s)
    ticks = fly_plan(replace(plan, scenario=probe.model_copy(update={"duration_s": 40.0}))).ticks
    own = ticks[(ticks["system_id"] == 2) & (ticks["time_s"] >= 0.0)]
    assert float(np.median(own["loop_delay_s"])) == pytest.approx(loop_s, abs=1e-4)
    squared = own["velocity_error_north_m_s"] ** 2 + own["velocity_error_east_m_s"] ** 2
    before, after = (float(squared[own["time_s"] // 10.0 == part].mean()) for part in (2, 3))
    growth_1_s = np.log(after / before) / 20.0
    timing = Timing(0.02, 0.02)
    computed = predicted_growth_rate(PAIR.A, PAIR.B, gains.K, timing, assumed_s=assumed_s, delay_s=loop_s)
    assert (growth_1_s < 0.0) == (computed < 0.0) == (abs(mismatch) < 0.05)
    assert growth_1_s == pytest.approx(computed, abs=0.03)  # other modes are still as large


def test_a_predicted_formation_settles_at_five_times_the_margin() -> None:
    ticks = fly_plan(flight_plan(scenario(1.5, link_s=1.49, duration_s=16.0))[1]).ticks
    assert errors_m(ticks, from_s=12.0) < 1e-3 * 172.4
    assert ticks["headroom"][ticks["time_s"] > 2.0].min() > 0.8
    assert set(ticks["assumed_delay_s"][ticks["time_s"] > 0.0]) == {1.5}


def test_without_prediction_the_same_formation_breaks() -> None:
    flight = fly_plan(flight_plan(scenario("off", link_s=1.49, duration_s=16.0))[1])
    assert "broken" in flight.events[-1].text


def test_the_measured_delay_is_followed() -> None:
    """Links that differ from vehicle to vehicle need no configuration."""
    ticks = fly_plan(flight_plan(scenario("measured", link_s=0.9, duration_s=12.0))[1]).ticks
    flown = ticks[ticks["time_s"] > 3.0]
    assert np.abs(flown["loop_delay_s"] - flown["assumed_delay_s"]).max() < 0.002  # the rounding of time_boot_ms
    assert errors_m(ticks, from_s=10.0) < 1e-3 * 172.4


@pytest.mark.slow(first=1)
@pytest.mark.parametrize("seed", [1, 5, 13])
def test_drift_to_ten_margins_leaves_true_errors_below_1_percent(seed: int) -> None:
    """20 ms to 1.5 s each way within a minute, +-30 ms of jitter, 5 % of all datagrams lost, at 91 m/s.

    An error of the assumed delay cancels, as a vehicle and the one in front are predicted to the same instant. Clock
    errors do not: they are position errors in proportion to the speed, which the station cannot see. Here the clocks
    are those of the first seconds. Each seed is one in which a line through the quickest single exchanges gave errors
    of 0.85 % to 1.36 %.
    """
    drift = (DelayPoint(at_s=0.0, delay_s=0.02), DelayPoint(at_s=60.0, delay_s=1.5))
    jitter = Jitter(distribution="uniform", scale_s=0.03)
    link = Link(delay_points=drift, jitter=jitter, loss_probability=0.05)
    flown = scenario("measured", link_s=0.0, duration_s=70.0, seed=seed)
    flown = flown.model_copy(update={"links": Links(up=link, down=link)})
    plan = flight_plan(flown)[1]
    station, fleet = Station(plan, start_ns=START_NS), Fleet(flown, START_NS)
    ticks: list[TickArray] = []
    largest_m = 0.0
    for tick in fly_lockstep(plan, station=station, vehicles=fleet):
        ticks.append(tick)
        if tick["time_s"][0] >= 12.0:
            now_ns = int(tick["sent_ns"][0])
            states = {own.system_id: fleet.state(own.system_id, now_ns) for own in flown.vehicles}
            largest_m = max(largest_m, *(_spacing_error_m(vehicle, states) for vehicle in flown.leader_first()[1:]))
    assert ticks[-1]["loop_delay_s"].min() > 2.9
    assert errors_m(np.concatenate(ticks), from_s=12.0) < 0.01 * 172.4
    assert largest_m < 0.01 * 172.4


def _spacing_error_m(vehicle: Vehicle, states: dict[int, State]) -> float:
    """How far a follower truly is from its place."""
    assert vehicle.follows is not None
    assert vehicle.offset_ne_m is not None
    own, front = states[vehicle.system_id], states[vehicle.follows]
    north_m, east_m = vehicle.offset_ne_m
    return float(np.hypot(own.north_m - front.north_m - north_m, own.east_m - front.east_m - east_m))


@pytest.mark.parametrize(("loop_s", "peak"), [(0.3, 1.0), (0.42, 1.25)])
def test_commands_grow_down_the_chain_as_computed(loop_s: float, peak: float) -> None:
    """Without mismatch, and half-way up the window: the spectra of the commands of the second and the third vehicle."""
    slow, base = 1.0, chain3(0.3)  # errors of the clocks are errors of position in proportion to the speed
    [leader] = [vehicle for vehicle in base.vehicles if vehicle.follows is None]
    formation = flight_plan(base)[1].formation
    place_ne_m = formation.place_ne_m() + leader.position_ne_m
    vehicles = tuple(
        vehicle.model_copy(
            update={
                "position_ne_m": tuple(place_ne_m[formation.row(vehicle.system_id)].tolist()),
                "velocity_ne_m_s": (slow + 3.0 * (vehicle is leader), 0.0),
            }
        )
        for vehicle in base.vehicles
    )
    changes = {
        "vehicles": vehicles,
        "nominal_velocity": (NominalVelocity(from_s=0.0, velocity_ne_m_s=(slow, 0.0)),),
        "limits": Limits(speed_min_m_s=0.1),
        "duration_s": 25.0,
    }
    plan = flight_plan(at_coordinates(base.model_copy(update=changes), {"delay": loop_s - 0.01}).with_calm_monitor())[1]
    ticks = fly_plan(plan).ticks
    ticks = ticks[ticks["commanded"]]
    assert np.median(ticks["loop_delay_s"]) == pytest.approx(loop_s, abs=0.004)
    omega = np.linspace(0.3, 8.0, 78)
    spectra = []
    for vehicle in base.leader_first()[1:]:
        rows = ticks[ticks["system_id"] == vehicle.system_id]
        spectra.append(np.exp(-1j * np.outer(omega, rows["due_ns"] * 1e-9)) @ rows["command_north_m_s2"])
    delay_s = float(np.median(ticks["loop_delay_s"][ticks["system_id"] == base.leader_first()[2].system_id]))
    K = ScalarGains(-GAINS.K1, GAINS.K2, GAINS.K3, 0.0).K
    loop = PredictedFigures(PAIR, K, 0.02, 0.3, (delay_s,), chain=True)
    strong = np.abs(spectra[0]) > 0.5 * np.abs(spectra[0]).max()
    flown, computed = np.abs(spectra[1] / spectra[0])[strong], loop.growth(omega[strong], delay_s)
    # the two vehicles' delays differ by milliseconds, and elsewhere rounding of telemetry is no longer small
    assert flown == pytest.approx(computed, abs=0.04)
    assert flown.max() == pytest.approx(peak, abs=0.05)
    assert flown.max() == pytest.approx(min(loop.string_peak, computed.max()), abs=0.03)


def chain3(prediction: float | str) -> Scenario:
    loaded = load(SCENARIOS / "chain3.toml")
    control = Control.model_validate({"gains": GAINS, "prediction": prediction})
    return loaded.model_copy(update={"control": control})
