"""What a scenario's design is asked for, and what is reported of it."""

from pathlib import Path

import pytest

from gains.formation.model import FormationModel
from gains.formation.pattern import overlapping
from gcs.plan.criteria import with_bounds
from gcs.plan.planner import flight_plan
from gcs.views.console import plain_console
from gcs.views.report import print_design
from scenarios.errors import ScenarioError
from scenarios.files import load, parse
from tests.support.paths import SCENARIOS

CHAIN = (SCENARIOS / "chain3.toml").read_text()
GRAPH = (SCENARIOS / "chain3_bidirectional.toml").read_text()


def chain_with(keys: str) -> str:
    """chain3 with other keys in [control]."""
    before, rest = CHAIN.split("[control]\n", 1)
    after = rest[rest.index("\n[") :]
    return f'{before}[control]\nmethod = "inclusion"\nloop = "ground"\n{keys}\n{after}'


def test_every_design_reports_its_criteria() -> None:
    for name in ("chain3", "chain3_bidirectional"):
        scenario = load(SCENARIOS / f"{name}.toml")
        found = with_bounds(flight_plan(scenario)[0], scenario)
        assert found.criteria is not None
        assert found.at_loop_delay is not None
        # as `gains.performance.flown` finds it
        assert found.criteria.alpha_at_delay == pytest.approx(found.at_loop_delay.alpha, rel=1e-6)
        assert found.criteria.alpha_bound is not None
        assert found.criteria.alpha_at_delay < found.criteria.alpha_bound
        console = plain_console()
        with console.capture() as printed:
            print_design(found, console)
        assert "which no controller exceeds" in printed.get()


@pytest.mark.parametrize(("rate_hz", "decay_1_s"), [(1.0, 0.020), (2.0, 0.030)])
def test_a_stable_loop_decays_at_slow_rates_too(rate_hz: float, decay_1_s: float) -> None:
    """Half a hold as delay calls these loops unstable; flights decay, as the sampled margin says."""
    scenario = load(SCENARIOS / "chain3.toml").at_rates(control_hz=rate_hz, telemetry_hz=rate_hz)
    found = flight_plan(scenario)[0]
    assert found.criteria is not None
    assert found.delay_margin_s is not None
    assert found.criteria.at_delay_s < found.delay_margin_s
    assert found.criteria.decay_rate_at_delay_1_s == pytest.approx(decay_1_s, abs=5e-4)
    assert 0.0 < found.criteria.alpha_at_delay < 0.03
    assert found.criteria.spacing_gain_s2 is None


@pytest.mark.parametrize("rate_hz", [1.0, 2.0])
def test_slow_rates_have_one_alpha_and_name_its_model(rate_hz: float) -> None:
    found = flight_plan(load(SCENARIOS / "chain3.toml").at_rates(control_hz=rate_hz, telemetry_hz=rate_hz))[0]
    assert found.criteria is not None
    assert found.at_loop_delay is not None
    assert found.at_loop_delay.alpha == pytest.approx(found.criteria.alpha_at_delay, rel=1e-9)
    assert found.at_loop_delay.string_peak is None
    console = plain_console()
    with console.capture() as printed:
        print_design(found, console)
    assert printed.get().count("in discrete time") == 2


def test_a_scenario_is_designed_for_its_delay() -> None:
    keys = '[control.criteria]\nat_delay_s = 0.3\nmaximise = "decay_rate_at_delay_1_s"'
    scenario = parse(chain_with(keys), Path("scenario.toml"))
    found = flight_plan(scenario)[0]
    assert found.criteria is not None
    assert found.criteria.at_delay_s == 0.3
    assert found.criteria.decay_rate_at_delay_1_s == pytest.approx((2 - 2**0.5) / 0.31, rel=1e-4)
    assert found.requirement is not None
    assert found.requirement.criteria is not None


@pytest.mark.parametrize(
    ("keys", "fault"),
    [
        ("[control.criteria]\nalpha_at_delay = 0.5", "no such key without at_delay_s"),
        ('[control.criteria]\nmaximise = "alpha_at_delay"', "a figure that needs no delay"),
        ("[control.criteria]\ndelays_s = [0.2, 0.1]", "the smaller delay first"),
        ("[control.criteria]\ndelay_rate = 0.5", "no such key without delays_s"),
        ("[control.overlap]\nahead = 2", "unless method is graph-lqr"),
        ('prediction = "measured"\n[control.criteria]\ndamping_min = 0.5', "no such key with prediction"),
        ("gains = { K1 = -1.0, K2 = 0.0, K3 = 1.0 }\n[control.criteria]\ndamping_min = 0.5", "either criteria"),
        ("[control.criteria]\ndamping_min = 1.5", "1"),
    ],
)
def test_keys_that_contradict_each_other_are_refused(keys: str, fault: str) -> None:
    with pytest.raises(ScenarioError, match=fault):
        parse(chain_with(keys), Path("scenario.toml"))


def test_criteria_are_refused_for_the_loop_on_board() -> None:
    text = chain_with("[control.criteria]\ndamping_min = 0.5").replace('loop = "ground"', 'loop = "onboard"')
    with pytest.raises(ScenarioError, match=r"ground, with control\.criteria"):
        parse(text, Path("scenario.toml"))


def test_overlaps_let_vehicles_hear_more_vehicles() -> None:
    text = GRAPH.replace("hears = [2]\n", "").replace("hears = [3]\n", "")
    scenario = parse(text.replace("[links]", "[control.overlap]\nahead = 2\n\n[links]"), Path("scenario.toml"))
    found = flight_plan(scenario)[0]
    assert {(block.vehicle, block.of) for block in found.blocks} == {(1, 1), (2, 1), (2, 2), (3, 1), (3, 2), (3, 3)}


def test_overlaps_reach_ahead_behind_and_to_the_leader() -> None:
    tree = FormationModel((-1, 0, 1, 2, 0))
    assert overlapping(tree, behind=True).links == (
        (0, 0), (0, 1), (0, 4), (1, 0), (1, 1), (1, 2), (2, 1), (2, 2), (2, 3), (3, 2), (3, 3), (4, 0), (4, 4),
    )  # fmt: skip
    assert [i for i, j in overlapping(tree, leader=True).links if j == 0] == [0, 1, 2, 3, 4]
    assert (3, 1) in overlapping(tree, ahead=2).links
    assert (3, 0) not in overlapping(tree, ahead=2).links
