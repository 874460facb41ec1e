"""What is varied in a campaign, and how it changes a scenario."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gcs.errors import InputError
from gcs.stress.axes import at_coordinates, has_constant_links, parse_axis, split_delay
from scenarios.files import with_loop
from scenarios.keys.link import Jitter, Link, LossBursts
from tests.support.fleets.stress_pair import SCENARIO


def test_axis_is_a_range_or_a_list() -> None:
    assert parse_axis("--delay", "0:0.6:4").values == (0.0, 0.2, 0.4, 0.6)
    assert parse_axis("--delay", "0.3,0.1,0.3").values == (0.3, 0.1)
    assert parse_axis("--delay-of", "2=0:0.1:2", (1, 2)).name == "delay_2"


@pytest.mark.parametrize("text", ["", "a", "0:1", "0:1:x", "0:1:0", "-0.1:0.1:3", "0:61:2", "nan", "0:inf:3"])
def test_a_bad_axis_is_refused_with_what_was_read(text: str) -> None:
    with pytest.raises(InputError, match="wanted FROM:TO:N"):
        parse_axis("--delay", text)


@pytest.mark.parametrize("text", ["3=0:1:2", "0:1:2", "two=0:1:2", "2"])
def test_axis_of_a_vehicle_names_a_vehicle_of_the_scenario(text: str) -> None:
    with pytest.raises(InputError, match="system id"):
        parse_axis("--delay-of", text, (1, 2))


@given(total_ms=st.integers(0, 2000), period_ms=st.sampled_from([2, 5, 10, 20, 50, 200]))
def test_the_up_link_takes_whole_periods_of_the_delay(total_ms: int, period_ms: int) -> None:
    period_s = period_ms * 1e-3
    up_s, down_s = split_delay(total_ms * 1e-3, period_s)
    assert up_s + down_s == pytest.approx(total_ms * 1e-3, abs=1e-9)
    assert up_s / period_s == pytest.approx(round(up_s / period_s), abs=1e-6)
    assert down_s >= 0.0
    assert abs(up_s - down_s) <= period_s + 1e-9


def test_every_coordinate_reaches_its_links_and_leaves_the_others() -> None:
    base = at_coordinates(SCENARIO, {"jitter": 0.01, "loss": 0.1})
    scenario = at_coordinates(base, {"delay": 0.2, "delay_2": 0.06, "rate": 100.0})
    assert (scenario.rates.control_hz, scenario.rates.telemetry_hz) == (100.0, 100.0)
    noisy = Link(jitter=Jitter(distribution="uniform", scale_s=0.01), loss_probability=0.1)
    for system_id, delay_s in ((1, 0.1), (2, 0.03)):
        assert scenario.link_of(system_id) == (noisy.model_copy(update={"delay_s": delay_s}),) * 2
    assert not has_constant_links(scenario)
    assert has_constant_links(at_coordinates(scenario, {"jitter": 0.0, "loss": 0.0}))


def test_jitter_keeps_the_distribution_that_a_link_has() -> None:
    gamma = Link(jitter=Jitter(distribution="gamma", scale_s=0.002, shape=3.0))
    own = SCENARIO.model_copy(update={"links": SCENARIO.links.model_copy(update={"up": gamma})})
    up, down = at_coordinates(own, {"jitter": 0.02}).link_of(1)
    assert up.jitter == Jitter(distribution="gamma", scale_s=0.02, shape=3.0)
    assert down.jitter == Jitter(distribution="uniform", scale_s=0.02)


def test_jitter_does_not_replace_measured_delays() -> None:
    traced = Link(jitter=Jitter(distribution="trace", trace_s=(0.01, 0.2)))
    own = SCENARIO.model_copy(update={"links": SCENARIO.links.model_copy(update={"up": traced})})
    with pytest.raises(InputError, match="--jitter: read links with a trace of measured delays, wanted jitter with"):
        at_coordinates(own, {"jitter": 0.02})


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_loss_takes_the_place_of_bursts(loss: float) -> None:
    bursty = Link(loss_bursts=LossBursts(to_bad_probability=0.02, to_good_probability=0.5))
    own = SCENARIO.model_copy(update={"links": SCENARIO.links.model_copy(update={"up": bursty, "down": bursty})})
    assert at_coordinates(own, {"loss": loss}).link_of(1) == (Link(loss_probability=loss),) * 2


@pytest.mark.parametrize(("hz", "sensor_hz", "rate_hz"), [(10.0, 50.0, 100.0), (40.0, 80.0, 160.0)])
def test_loop_on_board_is_no_slower_at_any_rate(hz: float, sensor_hz: float, rate_hz: float) -> None:
    own = with_loop(SCENARIO, "onboard", Path("here.toml"))
    assert (own.onboard.sensor_hz, own.onboard.rate_hz) == (50.0, 100.0)
    onboard = at_coordinates(own, {"rate": hz}).onboard
    assert (onboard.sensor_hz, onboard.rate_hz) == (sensor_hz, rate_hz)


def test_a_slower_telemetry_rate_of_its_own_stays() -> None:
    rates = SCENARIO.rates.model_copy(update={"telemetry_hz": 10.0})
    scenario = at_coordinates(SCENARIO.model_copy(update={"rates": rates}), {"rate": 25.0})
    assert (scenario.rates.control_hz, scenario.rates.telemetry_hz) == (25.0, 10.0)
