"""Onsets of a user's own laws and dynamics, found without a margin to start from."""

from collections.abc import Callable, Sequence

import pytest

from gcs.plan.planner import flight_plan
from gcs.stress.measure import fly_trial
from gcs.stress.study import NoOnset, Onset, Study, bracketed, find_onset
from gcs.stress.trial import Outcome, Trial
from scenarios.schema import Response, Scenario
from tests.support.fleets.own_code import coded, given


def growing_from(at_s: float) -> Callable[[float], float | None]:
    return lambda link_s: link_s - at_s


def always(growth_1_s: float | None) -> Callable[[float], float | None]:
    return lambda _: growth_1_s


def onset_of(scenario: Scenario) -> Onset:
    return find_onset(Study(flight_plan(scenario)[1]), lambda trials: list(map(fly_trial, trials)), tolerance=0.05)


def test_a_saturating_law_breaks_where_its_linear_part_does() -> None:
    """For small errors it is the linear law, whose margin another method computes."""
    onset = onset_of(coded(law="soft"))
    margin_s = flight_plan(given())[0].delay_margin_s
    assert onset.loop_delay_s == pytest.approx(margin_s, rel=1e-3)  # 1e-5 was seen; its probes begin with 3 cm
    assert onset.predicted_s is onset.difference is onset.predicted_continuous_s is None


def test_own_dynamics_with_a_lag_break_where_the_response_says() -> None:
    onset = onset_of(coded(dynamics="lagged", response=Response(lag_s=0.1)))
    assert onset.difference == pytest.approx(0.0, abs=0.01)
    assert onset.predicted_s == flight_plan(coded(dynamics="lagged", response=Response(lag_s=0.1)))[0].delay_margin_s


@pytest.mark.parametrize(
    ("growth_1_s", "wanted"),
    [
        (growing_from(0.15), (0.1, 0.2)),
        (growing_from(1.0), (0.8, 1.6)),
        (always(-1.0), "the margin is unknown, and errors decay in flights with up to 1.6 s of link delay"),
        (always(1.0), "errors grow at +1 1/s with the shortest link delay: no delay is stable"),
        (always(None), "the margin is unknown, and no growth rate could be measured at 0 s of link delay"),
    ],
)
def test_flights_find_between_which_delays_growth_begins(
    growth_1_s: Callable[[float], float | None], wanted: tuple[float, float] | str
) -> None:
    study, flown = Study(flight_plan(coded(law="soft"))[1]), list[float]()

    def run(trials: Sequence[Trial]) -> list[Outcome]:
        flown.extend(dict(trial.coordinates)["delay"] for trial in trials)
        return [
            Outcome(t.id, "probe", 1, {}, False, growth_1_s=growth_1_s(dict(t.coordinates)["delay"])) for t in trials
        ]

    assert bracketed(lambda s: study.trial("probe", {"delay": s}, seed=1), run) == wanted
    if isinstance(wanted, str):
        with pytest.raises(NoOnset, match=wanted.replace("+", r"\+")):
            find_onset(study, run, tolerance=0.02)
