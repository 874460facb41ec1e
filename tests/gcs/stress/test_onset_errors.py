"""Onsets that are not known well or that no link delay reaches, and sweeps that measure nothing."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from gcs.cli.results import print_disturbances
from gcs.plan.design import Design
from gcs.stress.disturbance import DisturbanceOnset, DisturbanceResult, missed
from gcs.stress.measure import fly_trial
from gcs.stress.report import CampaignResult, result_of
from gcs.stress.study import NoOnset, Onset, Study, find_onset
from gcs.stress.trial import Outcome, Trial
from scenarios.keys.link import Link, Links
from tests.support.fleets.stress_pair import SCENARIO, pair_plan

MARGIN_S = 0.5
STUDY = Study(pair_plan())


def onset(difference: float, error: float) -> Onset:
    """An onset by its difference and its standard error, both as shares of the margin."""
    at_s = MARGIN_S * (1.0 + difference)
    return Onset(
        loop_delay_s=at_s, error_s=error * MARGIN_S, predicted_s=MARGIN_S, predicted_continuous_s=None,
        difference=difference, link_delay_s=at_s - 0.01, link_delay_range_s=(at_s - 0.01, at_s - 0.01), waiting_s=0.01,
        waits_for="the control tick", slope_1_s2=1.0, frequency_rad_s=None, probed=2, critical=2, rounds=1, flights=(),
        checks=(), vehicle=None, link_delay_left_s=None, loop=(2,), own=(),
    )  # fmt: skip


def result(found: Onset | None, *, sweep: Sequence[Outcome] = (), allowed: float | None = 0.05) -> CampaignResult:
    design = Design(delay_margin_s=MARGIN_S)
    return result_of(STUDY, design, sweep, axes=[], sweep=sweep, onset=found, allowed=allowed)


@pytest.mark.parametrize(
    ("difference", "error", "said"),
    [
        (0.034, 0.178, "± 0.08900 s, an error of 17.800% of the margin 0.50000 s; 5% is allowed"),
        (0.06, 0.178, "+6.000% from the margin 0.50000 s; 5% is allowed"),
        (0.04, 0.04, ""),
    ],
)
def test_an_onset_is_asserted_no_finer_than_it_is_known(difference: float, error: float, said: str) -> None:
    found = result(onset(difference, error))
    assert found.passed == (not said)
    assert found.failure.endswith(said)
    assert found.failure.count("\n") == 0


def test_a_disturbance_is_asserted_no_finer_than_it_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    def found(error: float, difference: float | None = 0.0, *, radius: float | None = 2.0) -> DisturbanceOnset:
        return DisturbanceOnset(
            kind="dynamic", vehicles=(1, 2), radius_1_s=radius, frequency_rad_s=1.0,
            onset_1_s=None if difference is None else 2.0 * (1.0 + difference),
            error_1_s=2.0 * error, difference=difference, flights=3, measured=3,
            missing="none" if radius is None else "",
        )  # fmt: skip

    assert missed([found(0.04), found(0.04)], 0.05) is None
    assert missed([found(0.06), found(0.04)], 0.05) == "1 of 2 onsets are known less well than to 5.000% of the radius"
    assert missed([found(0.0, 0.06)], 0.05) == "1 of 1 onsets are farther than 5.000% from the radius"
    assert missed([found(0.0, None), found(0.0)], 0.05) == "1 of 2 onsets are not measured"
    never = found(0.0, None, radius=None)
    assert missed([never, found(0.0)], 0.05) is None  # nothing is predicted, so nothing is missed
    unbroken = DisturbanceResult(scenario="s", loop_delay_s=0.1, onsets=(never,))
    assert '"radius_1_s": null' in unbroken.to_json()
    print_disturbances(unbroken)
    assert "one follower, dynamic, none, by prediction alone" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("loop_delay_s", "growth", "error", "said"),
    [
        (0.4, 0.02, 0.001, True),
        (0.4, 0.02, 0.01, False),  # perhaps it does not grow
        (0.4, -0.1, 0.001, False),
        (0.5, 0.02, 0.001, True),  # as the probes of other vehicles, at the onset
        (0.4999, 0.0001, 0.0, False),
        (0.6, 0.1, 0.001, False),
    ],
)
def test_a_probe_that_grows_before_the_onset_contradicts_it(
    loop_delay_s: float, growth: float, error: float, said: bool
) -> None:
    probe = Outcome(
        "abc", "probe", 1, {"delay": loop_delay_s}, False, critical=3, growth_1_s=growth, growth_error_1_s=error,
        loop_delay_s=loop_delay_s,
    )  # fmt: skip
    near = tuple(replace(probe, growth_1_s=rate, loop_delay_s=0.5 + rate) for rate in (-0.01, 0.01))
    for allowed in (None, 0.05):
        found = result(replace(onset(0.0, 0.001), flights=near, checks=(probe,)), allowed=allowed)
        line = f"errors of vehicle 3 grow at +0.02 1/s already at {loop_delay_s:.5f} s of loop delay (trial abc)"
        assert found.onset_contradicted == (line if said else "")
        assert found.failure == (line if said and allowed is not None else "")


@pytest.mark.parametrize(
    ("waiting_s", "spread_s", "said"),
    [
        (0.3, 0.2, r"breaks without any link delay: growth passes zero at 0\.2.* s ± .* s of loop delay, and waiting"),
        (
            0.35,
            0.0,
            r"breaks without any link delay: errors grow in \d+ flights with 0\.000 to .* waiting",
        ),
    ],
)
def test_an_onset_that_waiting_exceeds_is_not_a_link_delay(waiting_s: float, spread_s: float, said: str) -> None:
    """Flights whose growth is zero at 0.27 s, and that wait longer than that, always or on average."""
    with pytest.raises(NoOnset, match=said):
        search_among_waits(waiting_s, spread_s, block_s=0.27)


def test_a_link_delay_is_known_no_finer_than_the_waits() -> None:
    found = search_among_waits(0.15, 0.1, block_s=0.6)
    least_s, most_s = found.link_delay_range_s
    assert (least_s, most_s) == pytest.approx((0.35, 0.55), abs=2e-3)
    assert least_s < found.link_delay_s < most_s
    assert found.waits_for == "lost datagrams and the control tick"


def search_among_waits(waiting_s: float, spread_s: float, *, block_s: float) -> Onset:
    """The onset among flights over lossy links whose growth is zero at `block_s` and whose waits differ."""

    def fly(trial: Trial) -> Outcome:
        link_s = dict(trial.coordinates)["delay"]
        loop_s = link_s + waiting_s + spread_s * (trial.scenario.seed % 5 - 2.0) / 2.0
        growth_1_s = loop_s - block_s
        known = Outcome(trial.id, trial.kind, trial.scenario.seed, dict(trial.coordinates), real_time=False)
        delays = {"link_delay_s": link_s, "loop_delay_s": loop_s, "waiting_s": waiting_s}
        return replace(known, **delays, growth_1_s=growth_1_s, growth_error_1_s=1e-3, probed=2, critical=2)

    lossy = SCENARIO.model_copy(update={"links": Links(up=Link(loss_probability=0.1))})
    study = replace(STUDY, plan=replace(STUDY.plan, scenario=lossy, delay_margin_s=block_s))
    return find_onset(study, lambda trials: [fly(trial) for trial in trials], tolerance=0.05)


def aborted(trial: Trial) -> Outcome:
    """The outcome of a trial whose vehicles hear nothing."""
    deaf = Links(up=Link(loss_probability=1.0), down=Link(loss_probability=1.0))
    return fly_trial(replace(trial, scenario=trial.scenario.model_copy(update={"links": deaf})))


def test_a_sweep_that_only_aborts_fails_and_says_why() -> None:
    sweep = [aborted(STUDY.trial(kind, {"delay": 0.0}, seed=7)) for kind in ("probe", "own")]
    assert [own.verdict for own in sweep] == ["aborted", "aborted"]
    assert [(own.loop_delay_s, own.waiting_s, own.predicted_growth_1_s) for own in sweep] == [(None, None, None)] * 2
    found = result(None, sweep=sweep, allowed=None)
    assert not found.passed
    assert found.failure == f"nothing was measured: all 2 trials were aborted, the first: {sweep[0].reason}"
    assert result(None, sweep=[replace(sweep[0], verdict="stable"), sweep[1]], allowed=None).passed


def test_a_search_whose_first_flights_all_abort_goes_no_further() -> None:
    flown: list[Outcome] = []

    def run(trials: Sequence[Trial]) -> list[Outcome]:
        flown.extend(aborted(trial) for trial in trials)
        return flown

    with pytest.raises(NoOnset, match="all 5 flights were aborted, the first: not ready"):
        find_onset(STUDY, run, tolerance=0.05)
    assert len(flown) == 5
    assert not result_of(
        STUDY, Design(delay_margin_s=MARGIN_S), flown, axes=[], sweep=[], onset=None, allowed=None
    ).passed
