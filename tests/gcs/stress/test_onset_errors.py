"""What an onset says that is not known well, or that no link delay reaches; and a sweep that measures nothing."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from gcs.plan.design import Design
from gcs.stress.measure import fly_trial
from gcs.stress.report import CampaignResult, result_of
from gcs.stress.study import NoOnset, Onset, Study, find_onset
from gcs.stress.trial import Outcome, Trial
from scenarios.keys.link import Link, Links
from tests.support.fleets.stress_pair import SCENARIO, pair_plan

MARGIN_S = 0.5
STUDY = Study(pair_plan())


def result(found: Onset | None, *, sweep: Sequence[Outcome] = (), allowed: float | None = 0.05) -> CampaignResult:
    design = Design(delay_margin_s=MARGIN_S)
    return result_of(STUDY, design, sweep, axes=[], sweep=sweep, onset=found, allowed=allowed)


@pytest.mark.parametrize(
    ("waiting_s", "spread_s", "said"),
    [
        (0.3, 0.2, r"breaks without any link delay: growth passes zero at 0\.2.* s ± .* s of loop delay, and waiting"),
        (0.35, 0.0, r"the formation breaks without any link delay: errors grow in \d+ flights with 0\.000 to"),
    ],
)
def test_an_onset_that_waiting_exceeds_is_not_a_link_delay(waiting_s: float, spread_s: float, said: str) -> None:
    """Flights whose growth is zero at 0.27 s, and that wait longer than that: always, or in the mean."""
    block_s = 0.27

    def fly(trial: Trial) -> Outcome:
        link_s = dict(trial.coordinates)["delay"]
        loop_s = link_s + waiting_s + spread_s * (trial.scenario.seed % 5 - 2.0) / 2.0
        growth_1_s = loop_s - block_s
        known = Outcome(trial.id, trial.kind, trial.scenario.seed, dict(trial.coordinates), real_time=False)
        delays = {"link_delay_s": link_s, "loop_delay_s": loop_s, "waiting_s": waiting_s}
        return replace(known, **delays, growth_1_s=growth_1_s, growth_error_1_s=1e-3, probed=2, critical=2)

    lossy = SCENARIO.model_copy(update={"links": Links(up=Link(loss_probability=0.1))})
    study = replace(STUDY, plan=replace(STUDY.plan, scenario=lossy, delay_margin_s=block_s))
    with pytest.raises(NoOnset, match=said):
        find_onset(study, lambda trials: [fly(trial) for trial in trials], tolerance=0.05)


def aborted(trial: Trial) -> Outcome:
    """The outcome of a trial whose vehicles hear nothing."""
    deaf = Links(up=Link(loss_probability=1.0), down=Link(loss_probability=1.0))
    return fly_trial(replace(trial, scenario=trial.scenario.model_copy(update={"links": deaf})))


def test_a_sweep_that_only_aborts_fails_and_says_why() -> None:
    sweep = [aborted(STUDY.trial(kind, {"delay": 0.0}, seed=7)) for kind in ("probe", "own")]
    assert [own.verdict for own in sweep] == ["aborted", "aborted"]
    assert [(own.loop_delay_s, own.waiting_s, own.predicted_growth_1_s) for own in sweep] == [(None, None, None)] * 2
    told = result(None, sweep=sweep, allowed=None)
    assert not told.passed
    assert told.failure == f"nothing was measured: all 2 trials were aborted, the first: {sweep[0].reason}"
    assert result(None, sweep=[replace(sweep[0], verdict="stable"), sweep[1]], allowed=None).passed
