"""The search for both onsets of a loop with prediction over a fixed delay, among flights that grow as modelled.

`tests/flights/loops/test_predicted_flight.py` flies at both ends of a window.
"""

from dataclasses import replace

import pytest

from gcs.plan.loops import plan_loops
from gcs.plan.planner import flight_plan
from gcs.stress.report import result_of
from gcs.stress.study import NoOnset, Onset, Study, curve_error, find_onset
from gcs.stress.trial import Outcome, Trial
from scenarios.files import load
from scenarios.schema import Control, FixedGains, Rates
from tests.support.paths import SCENARIOS

WAITING_S = 0.007
GAINS = FixedGains(K1=-3.408, K2=0.631, K3=5.608)


@pytest.fixture(scope="module")
def study() -> Study:
    control = Control.model_validate({"gains": GAINS, "prediction": 0.6})
    scenario = load(SCENARIOS / "chain3.toml").model_copy(update={"control": control})
    return Study(flight_plan(scenario.with_calm_monitor())[1])


def test_the_window_is_the_published_one(study: Study) -> None:
    least_s, most_s = study.window_s
    assert (0.6 - least_s, most_s - 0.6) == pytest.approx((0.149, 0.156), abs=1e-3)


def search(study: Study, *, shorter: bool, waiting_s: float = WAITING_S) -> Onset:
    block = plan_loops(study.plan)[-1]

    def fly(trial: Trial) -> Outcome:
        link_s = dict(trial.coordinates)["delay"]
        growth_1_s = block.growth_1_s(link_s + waiting_s)
        verdict = "unstable" if growth_1_s > 0.0 else "stable"
        known = Outcome(trial.id, trial.kind, 1, dict(trial.coordinates), real_time=False, verdict=verdict)
        delays = {"link_delay_s": link_s, "loop_delay_s": link_s + waiting_s, "waiting_s": waiting_s}
        rates = {"growth_1_s": growth_1_s, "growth_error_1_s": 1e-6, "predicted_growth_1_s": growth_1_s}
        return replace(known, **delays, **rates, probed=block.system_ids[0], critical=block.system_ids[0])

    return find_onset(study, lambda trials: [fly(trial) for trial in trials], tolerance=0.01, shorter=shorter)


@pytest.mark.parametrize("shorter", [False, True])
def test_the_search_ends_at_either_end_of_the_window(study: Study, *, shorter: bool) -> None:
    onset = search(study, shorter=shorter)
    assert onset.predicted_s == pytest.approx(study.window_s[0 if shorter else 1], rel=1e-9)
    assert onset.difference is not None
    assert abs(onset.difference) < 1e-4
    assert onset.link_delay_s == pytest.approx(onset.loop_delay_s - WAITING_S)
    assert [flight.verdict for flight in onset.own] == (["unstable", "stable"] if shorter else ["stable", "unstable"])
    assert curve_error(onset.flights) == pytest.approx(0.0)


def test_upper_onset_stays_if_no_link_delay_is_too_short(study: Study) -> None:
    onset = search(study, shorter=False)
    control = Control.model_validate({"delay_margin_s": 0.3, "prediction": 0.55})
    slow = load(SCENARIOS / "chain3.toml").model_copy(
        update={"control": control, "rates": Rates(control_hz=2.5, telemetry_hz=2.5)}
    )
    design, plan = flight_plan(slow.with_calm_monitor())
    with pytest.raises(NoOnset, match="no link delay is short enough to break the formation: errors decay in") as why:
        search(Study(plan), shorter=True, waiting_s=0.2)  # the window begins at 0.08 s
    found = result_of(study, design, [], axes=[], sweep=[], onset=onset, onset_shorter=why.value, allowed=0.05)
    assert found.passed
    assert found.onset is onset
    assert found.onset_shorter_missing == str(why.value)
