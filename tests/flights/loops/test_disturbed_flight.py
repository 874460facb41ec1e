"""Disturbed formations: what is flown against what is computed."""

import numpy as np
import pytest

from gcs import fly_virtual
from gcs.plan.disturbed import predicted_spread
from gcs.plan.planner import flight_plan
from gcs.stress.disturbance import find_disturbance_onsets
from scenarios.files import load
from scenarios.keys.autopilot import Response
from scenarios.keys.disturbance import Disturbance, Gusts, Navigation, Sector
from scenarios.schema import Clocks, NominalVelocity, Scenario
from scenarios.shipped import located

AIR = Disturbance(wind_ne_m_s2=(0.2, -0.1), gusts=Gusts(deviation_m_s2=0.4, correlation_time_s=0.2))
NOISE = Navigation(position_noise_m=0.3, velocity_noise_m_s=0.1)


def chain(**update: object) -> Scenario:
    return load(located("chain3")).with_calm_monitor().model_copy(update=update)


@pytest.mark.slow(first=2)
@pytest.mark.parametrize("prediction", ["off", "measured"])
@pytest.mark.parametrize("delay_s", [0.05, 0.15, 0.25])
def test_flown_spread_of_the_errors_is_the_computed_one(delay_s: float, prediction: str) -> None:
    together = Clocks(offset_max_s=0.0, drift_max_ppm=0.0)  # else noise is averaged between two reports
    noisy = chain(disturbance=AIR, navigation=NOISE, clocks=together, duration_s=40.0)
    control = noisy.control.model_copy(update={"prediction": prediction})
    noisy = noisy.model_copy(update={"control": control})
    flown = fly_virtual(noisy.with_link_delay(up_s=0.4 * delay_s, down_s=0.6 * delay_s))
    assert flown.summary.loop_delay_s.p50 == pytest.approx(delay_s, abs=1e-3)
    assert flown.summary.spread is not None
    ratios = [(own.reported_rms_m or 0.0) / (own.predicted_rms_m or 1.0) for own in flown.summary.spread.vehicles]
    # most of the power is white noise; the rest has about 40 independent values on each axis: 3 % for all together
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)
    assert ratios == pytest.approx([1.0, 1.0], abs=0.08)


@pytest.mark.parametrize("prediction", ["off", "measured"])
def test_spread_is_computed_for_vehicles_that_sample_at_other_instants(prediction: str) -> None:
    apart = chain(navigation=NOISE, clocks=Clocks(drift_max_ppm=0.0), duration_s=40.0, seed=3)
    apart = apart.model_copy(update={"control": apart.control.model_copy(update={"prediction": prediction})})
    flown = fly_virtual(apart.with_link_delay(up_s=0.04, down_s=0.06))
    assert flown.summary.spread is not None
    before = predicted_spread(flown.design, apart, flown.summary.spread.loop_delay_s)
    assert before is not None
    lessened = [
        (own.predicted_rms_m or 0.0) / together.reported_rms_m
        for own, together in zip(flown.summary.spread.vehicles, before.vehicles, strict=True)
    ]
    assert min(lessened) < 0.9  # of a vehicle whose reports fall between those of the one in front
    ratios = [(own.reported_rms_m or 0.0) / (own.predicted_rms_m or 1.0) for own in flown.summary.spread.vehicles]
    assert ratios == pytest.approx([1.0, 1.0], abs=0.05)


def test_the_same_seed_gives_the_same_disturbed_flight() -> None:
    first, second = (fly_virtual(chain(disturbance=AIR, navigation=NOISE, duration_s=3.0)) for _ in range(2))
    assert first.ticks.tobytes() == second.ticks.tobytes()


def test_a_disturbance_of_size_zero_changes_no_flight() -> None:
    still = Sector(norm_1_s=0.0, direction=tuple(tuple(row) for row in np.eye(5).tolist()))
    calm, pushed = (fly_virtual(chain(duration_s=3.0, disturbance=each)) for each in (None, Disturbance(sector=still)))
    # motion is cut into other pieces, so positions differ by their rounding in telemetry: 1e-4 m at 500 m
    error_m = calm.spacing_error_ne_m - pushed.spacing_error_ne_m
    assert np.nanmax(np.abs(error_m)) < 1e-3


def test_the_formation_breaks_at_its_stability_radius() -> None:
    pair = chain(vehicles=chain().vehicles[:2]).with_link_delay(up_s=0.1, down_s=0.0844)
    result = find_disturbance_onsets(flight_plan(pair)[1], tolerance=0.02, kinds=("dynamic",))
    [onset] = result.onsets
    assert onset.difference is not None
    assert abs(onset.difference) < 5e-3


def test_a_slow_formation_is_disturbed_from_smaller_errors() -> None:
    slow = {"nominal_velocity": (NominalVelocity(from_s=0.0, velocity_ne_m_s=(8.0, 0.0)),)}
    pair = chain(vehicles=chain().vehicles[:2], **slow).with_link_delay(up_s=0.1, down_s=0.0844)
    result = find_disturbance_onsets(flight_plan(pair)[1], tolerance=0.02, kinds=("constant",))
    [onset] = result.onsets
    assert (onset.missing, result.failure) == ("", None)
    assert onset.difference == pytest.approx(0.0, abs=5e-3)
    assert onset.flights == onset.measured + 1  # errors of 5 m leave the linear range


def test_a_formation_too_slow_for_any_disturbance_says_so() -> None:
    still = {"nominal_velocity": (NominalVelocity(from_s=0.0, velocity_ne_m_s=(0.02, 0.0)),)}
    pair = chain(vehicles=chain().vehicles[:2], **still).with_link_delay(up_s=0.1, down_s=0.0844)
    result = find_disturbance_onsets(flight_plan(pair)[1], tolerance=0.02, kinds=("constant",))
    assert result.failure == "1 of 1 onsets are not measured"
    [onset] = result.onsets
    assert (onset.measured, onset.difference) == (0, None)
    assert onset.missing.startswith(f"no growth rate in {onset.flights} flights, which left the linear range")


def test_flown_spread_of_copters_is_the_computed_one() -> None:
    copters = load(located("copters5")).with_calm_monitor().in_steady_flight()
    flown = fly_virtual(
        copters.model_copy(
            update={
                "vehicles": copters.vehicles[:3],
                "response": Response(lag_s=copters.autopilot.lag_s, velocity_gain_1_s=2.0),
                "disturbance": Disturbance(gusts=Gusts(deviation_m_s2=0.3, correlation_time_s=0.3)),
                "navigation": Navigation(position_noise_m=0.1, velocity_noise_m_s=0.05),
                "clocks": Clocks(offset_max_s=0.0, drift_max_ppm=0.0),
                "duration_s": 60.0,
            }
        ).with_link_delay(up_s=0.025, down_s=0.025)
    )
    assert flown.summary.spread is not None
    ratios = [(own.reported_rms_m or 0.0) / (own.predicted_rms_m or 1.0) for own in flown.summary.spread.vehicles]
    # in 120 s flown and computed agree within 3 %; a model without gusts in the velocity deficit would give 1.4
    assert ratios == pytest.approx([1.0, 1.0], abs=0.1)
