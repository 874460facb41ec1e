"""The expected loop delay of jittery links against flights."""

import pytest

from gcs import fly_virtual
from gcs.plan.expected_delay import expected_loop_delay_s, late_loop_delay_s
from scenarios.files import load, with_profile
from scenarios.keys.link import Jitter, Link, Links
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
    assert late_loop_delay_s(scenario, 0.99) == pytest.approx(latest_s, rel=0.1)


def test_jitter_that_is_never_negative_exceeds_its_mean() -> None:
    assert expected_loop_delay_s(over(Jitter(distribution="uniform", scale_s=0.05), 0.005)) > 0.04
