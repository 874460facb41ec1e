"""The lines over a map: where the models say the formation breaks, and where it is proved not to."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from gcs.plan.loops import plan_loops
from gcs.stress.axes import Axis, at_coordinates
from gcs.stress.boundary import cell_edges, guaranteed_line, map_figure, two_delays_lines
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from gcs.stress.trial import Outcome, plan_of
from scenarios.keys.link import Jitter, Link
from scenarios.schema import FixedGains
from tests.support.fleets.stress_pair import SCENARIO, pair_plan

DELAY_JITTER = (Axis("delay", (0.02, 0.25)), Axis("jitter", (0.0, 0.05)))


def test_flights_on_the_guaranteed_line_are_stable() -> None:
    study = Study(pair_plan())
    line = guaranteed_line(study, DELAY_JITTER)
    assert line is not None
    assert line[:, 0].max() < study.plan.delay_margin_s
    assert (line[:, 1] <= line[:, 0] / 2.0).all()  # no delay below zero
    assert line[:, 1].max() > 0.02
    for delay_s, jitter_s in line[:: len(line) // 3].tolist():
        outcome = fly_trial(study.trial("probe", {"delay": delay_s, "jitter": jitter_s}, seed=7))
        assert (outcome.growth_1_s or 0.0) < 0.0


@pytest.mark.parametrize(
    ("axes", "distribution"),
    [((Axis("delay", (0.0, 0.2)), Axis("loss", (0.0, 0.2))), "uniform"), (DELAY_JITTER, "normal")],
)
def test_nothing_is_guaranteed_where_no_delay_is_the_longest(axes: tuple[Axis, Axis], distribution: str) -> None:
    jitter = Jitter.model_validate({"distribution": distribution, "scale_s": 0.01})
    links = SCENARIO.links.model_copy(update={"up": Link(jitter=jitter), "down": Link(jitter=jitter)})
    plan = replace(pair_plan(), scenario=SCENARIO.model_copy(update={"links": links}))
    assert guaranteed_line(Study(plan), axes) is None


def predicting(prediction: float | str, *, gains: FixedGains | None = None, **changes: object) -> Study:
    control = SCENARIO.control.model_copy(update={"prediction": prediction})
    plan = replace(pair_plan(), scenario=SCENARIO.model_copy(update={"control": control, **changes}))
    if gains is not None:
        one = np.eye(2)
        plan = replace(plan, gain=plan.model.overlapping_gain(gains.K1 * one, gains.K2 * one, gains.K3 * one))
    return Study(plan)


def test_predicted_flights_on_the_guaranteed_line_are_stable() -> None:
    line = guaranteed_line(predicting(0.3), (Axis("delay", (0.1, 0.5)), Axis("jitter", (0.0, 0.05))))
    assert line is not None
    top = int(line[:, 1].argmax())
    assert line[top, 1] > 0.015
    # it falls on either side of the delay without mismatch: the assumed one less half a period of waiting
    assert line[top, 0] == pytest.approx(0.29, abs=0.01)
    halving_s = 1e-5  # what is left of the bisected interval
    assert (np.diff(line[: top + 1, 1]) >= -halving_s).all()
    assert (np.diff(line[top:, 1]) <= halving_s).all()
    for delay_s, jitter_s in (line[0], line[top], line[-1]):
        coordinates = {"delay": float(delay_s), "jitter": float(jitter_s)}
        outcome = fly_trial(predicting(0.3).trial("probe", coordinates, seed=7))
        assert (outcome.growth_1_s or 0.0) < 0.0


@pytest.mark.parametrize(("assumed_s", "jitter_s"), [(0.3, 0.0305), (0.6, 0.027), (1.5, 0.017)])
def test_jitter_proved_each_way_is_that_of_the_documentation(assumed_s: float, jitter_s: float) -> None:
    """docs/explanation/prediction.md, at the link delay that suits the assumed one."""
    gains = FixedGains(K1=-3.408, K2=0.631, K3=5.608)
    line = guaranteed_line(
        predicting(assumed_s, gains=gains), (Axis("delay", (assumed_s - 0.02, assumed_s)), DELAY_JITTER[1])
    )
    assert line is not None
    assert line[:, 1].max() == pytest.approx(jitter_s, abs=0.0005)  # rounded to a millisecond


def test_nothing_is_proved_of_measured_or_overtaking_deliveries() -> None:
    assert guaranteed_line(predicting("measured"), DELAY_JITTER) is None
    overtaking = Link(reordering=True)
    links = SCENARIO.links.model_copy(update={"up": overtaking, "down": overtaking})
    assert guaranteed_line(predicting(0.1, links=links), DELAY_JITTER) is None
    assert guaranteed_line(predicting(0.1), DELAY_JITTER) is not None


def test_lines_of_two_delays_are_those_without_prediction() -> None:
    study = predicting(0.6)
    assert two_delays_lines(study, (Axis("delay_1", (0.1, 0.5)), Axis("delay_2", (0.1, 0.5))), []) == []


def test_maps_with_and_without_prediction_are_drawn_side_by_side(tmp_path: Path) -> None:
    """One campaign flies both; every cell keeps its assumed delay, and neither map shows flights of the other."""
    study = Study(pair_plan())
    axes = [Axis("delay", (0.2, 0.6)), Axis("loss", (0.0, 0.2)), Axis("prediction", (0.0, 0.6))]
    trials = study.sweep(axes, seeds=1)
    assert len(trials) == 2 * 8  # probes and flights from the start
    outcomes: list[Outcome] = []
    for trial in trials:
        at = dict(trial.coordinates)
        assert plan_of(trial).assumed_s == (at["prediction"] or None)
        growth = abs(at["delay"] - at["prediction"]) - 0.3
        outcomes.append(
            Outcome(
                trial.id, trial.kind, 1, at, real_time=False,
                growth_1_s=growth, predicted_growth_1_s=growth, verdict="unstable" if growth > 0.0 else "stable",
            )
        )  # fmt: skip
    drawn = [
        map_figure(tmp_path / f"{len(own[2].values)}.png", study=study, axes=own, outcomes=outcomes, verdicts=outcomes)
        for own in (axes, [axes[0], axes[1], Axis("prediction", (0.6,))])
    ]
    both, one = (imread(file).shape[1] for file in drawn if file is not None)
    assert both > 1.4 * one


def test_two_loops_of_a_tree_break_along_a_rectangle() -> None:
    """The sides are the sampled margins less the waiting, as exactly as the hold counts as half a period."""
    study = Study(pair_plan())
    axes = (Axis("delay_1", (0.1, 0.5)), Axis("delay_2", (0.1, 0.5)))
    near = [
        fly_trial(study.trial("probe", {"delay_1": at, "delay_2": at}, seed=7, probe=k))
        for k, at in ((1, 0.2), (2, 0.1))
    ]
    lines = np.concatenate(two_delays_lines(study, axes, near))
    for k, loop in enumerate(plan_loops(study.plan)):
        waiting_s = near[k].waiting_s
        assert waiting_s is not None
        side_s = loop.margin_s() - waiting_s
        assert np.abs(lines[:, k] - side_s).min() < 1e-3
        assert lines[:, k].max() < side_s + 1e-3


def test_loops_of_several_vehicles_have_no_such_rectangle() -> None:
    plan = pair_plan()
    gain = plan.gain.copy()
    gain[0, 2] = 0.5  # the leader uses the follower's spacing: one loop of two
    study = Study(replace(plan, gain=gain, scenario=at_coordinates(SCENARIO, {"delay": 0.02})))
    assert two_delays_lines(study, (Axis("delay_1", (0.1, 0.5)), Axis("delay_2", (0.1, 0.5))), []) == []


@pytest.mark.parametrize(
    ("values", "edges"),
    [
        ([0.2, 0.25, 0.4], [0.175, 0.225, 0.325, 0.475]),
        ([0.2], [0.18, 0.22]),
        ([0.0], [-0.01, 0.01]),
    ],
)
def test_cells_of_the_map_end_halfway_between_values(values: list[float], edges: list[float]) -> None:
    assert cell_edges(np.array(values)) == pytest.approx(edges)
