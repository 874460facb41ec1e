"""The expected loop delay of jittery links against flights."""

import numpy as np
import pytest

from gcs import fly_virtual
from gcs.drive.check import check
from gcs.plan.expected_delay import expected_loop_delay_s, planned_loop_delays_s
from gcs.plan.planner import flight_plan
from scenarios.files import load, with_loop, with_profile
from scenarios.keys.link import Jitter, Link, Links, VehicleLinks
from scenarios.keys.part import Prediction
from scenarios.schema import Scenario
from scenarios.shipped import FOLDER


def calm_chain() -> Scenario:
    scenario = load(FOLDER / "chain3.toml").with_calm_monitor()
    control = scenario.control.model_copy(update={"delay_margin_s": 1.0})
    return scenario.model_copy(update={"control": control, "duration_s": 15.0})


def over(jitter: Jitter, delay_s: float) -> Scenario:
    link = Link(delay_s=delay_s, jitter=jitter)
    return calm_chain().model_copy(update={"links": Links(up=link, down=link)})


@pytest.mark.parametrize(
    "scenario",
    [
        over(Jitter(distribution="uniform", scale_s=0.05), 0.005),
        over(Jitter(distribution="normal", scale_s=0.02), 0.05),
        with_profile(calm_chain(), "lte", FOLDER / "chain3.toml"),
    ],
    ids=["uniform", "normal", "lte"],
)
def test_expected_and_late_loop_delay_are_those_of_flights(scenario: Scenario) -> None:
    flown = fly_virtual(scenario).summary
    slowest_s, latest_s = (max(getattr(own.loop_delay_s, at) for own in flown.vehicles) for at in ("p50", "p99"))
    # 450 down delays and three phases: 2 % of standard error
    assert expected_loop_delay_s(scenario) == pytest.approx(slowest_s, rel=0.05)
    assert check(flight_plan(scenario)[1]).loop_delay_s_p99 == pytest.approx(latest_s, rel=0.1)


@pytest.mark.parametrize("prediction", ["off", "measured", 0.2])
@pytest.mark.parametrize("name", ["chain3", "thesis_delay"], ids=["on the ground", "on board"])
def test_late_headroom_is_that_of_flights(name: str, prediction: Prediction) -> None:
    scenario = load(FOLDER / f"{name}.toml").with_calm_monitor()
    control = scenario.control.model_copy(update={"prediction": prediction})
    link = Link(delay_s=0.05, jitter=Jitter(distribution="uniform", scale_s=0.05))
    changed = {"control": control, "links": Links(up=link, down=link), "duration_s": 20.0}
    scenario = scenario.model_copy(update=changed)
    flown = fly_virtual(scenario).ticks
    flown = flown[flown["time_s"] > 5.0]
    late = [np.quantile(flown["headroom"][flown["system_id"] == own], 0.01) for own in (1, 2, 3)]
    expected = check(flight_plan(scenario)[1])
    assert expected.headroom_p99 == pytest.approx(min(late), abs=0.05)
    assert (expected.headroom_p99 or 0.0) < (expected.headroom or 0.0) - 0.02  # the median tells nothing of jitter


def test_jitter_that_is_never_negative_exceeds_its_mean() -> None:
    assert expected_loop_delay_s(over(Jitter(distribution="uniform", scale_s=0.05), 0.005)) > 0.04


@pytest.mark.parametrize(
    ("name", "expected_s"),
    [("thesis_delay", [0.05, 0.1, 0.1]), ("chain3", [0.05, 0.05, 0.15])],
    ids=["neighbours' states", "nothing is streamed"],
)
def test_on_board_the_slowest_state_that_a_command_needs_counts(name: str, expected_s: list[float]) -> None:
    fast, slow = Link(delay_s=0.02), Link(delay_s=0.07)
    links = Links(up=fast, down=fast, vehicles=(VehicleLinks(system_id=3, up=slow, down=slow),))
    file = FOLDER / f"{name}.toml"
    scenario = with_loop(load(file), "onboard", file).model_copy(update={"links": links, "duration_s": 10.0})
    assert list(planned_loop_delays_s(flight_plan(scenario)[1]).values()) == pytest.approx(expected_s)
    flown_s = [own.loop_delay_s.p50 for own in fly_virtual(scenario).summary.vehicles]
    assert flown_s == pytest.approx(expected_s, abs=0.01)  # half of a period, as phases happen to be
