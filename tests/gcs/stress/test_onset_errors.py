"""What an onset says that is not known well, or that no link delay reaches; and a sweep that measures nothing."""

from dataclasses import replace

import pytest

from gcs.stress.study import NoOnset, Study, find_onset
from gcs.stress.trial import Outcome, Trial
from scenarios.keys.link import Link, Links
from tests.support.fleets.stress_pair import SCENARIO, pair_plan

STUDY = Study(pair_plan())


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
