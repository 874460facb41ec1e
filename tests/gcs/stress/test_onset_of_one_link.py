"""The onset where the link of one vehicle alone is slowed, and the model of loops whose links differ."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from gcs import fly_virtual
from gcs.cli.main import app
from gcs.errors import InputError
from gcs.plan.loops import growth_of, plan_loops, plan_over_links, window_of
from gcs.plan.planner import flight_plan, over_own_links
from gcs.preflight.check import check
from gcs.stress.measure import fly_trial
from gcs.stress.study import NoOnset, Onset, Study, find_onset
from scenarios.files import dump, load, parse
from scenarios.keys.course import Course
from scenarios.keys.link import Jitter, Link, VehicleLinks
from scenarios.schema import Scenario
from scenarios.shipped import located
from tests.support.fleets.stress_pair import SCENARIO
from tests.support.known import known

EACH_OTHER = """
name = "each_other"
seed = 1
duration_s = 20.0
nominal_velocity = [{ from_s = 0.0, velocity_ne_m_s = [25.0, 0.0] }]
vehicles = [
    { system_id = 1, position_ne_m = [0, 0], velocity_ne_m_s = [25, 0] },
    { system_id = 2, follows = 1, offset_ne_m = [-40, 40], position_ne_m = [-40.2, 40.1], velocity_ne_m_s = [25, 0] },
]
[control]
blocks = [
    { vehicle = 1, of = 1, gain = [[-0.7, 0.0], [0.0, -0.7]] },
    { vehicle = 1, of = 2, gain = [[3.0, 0.0, -1.0, 0.0], [0.0, 3.0, 0.0, -1.0]] },
    { vehicle = 2, of = 1, gain = [[0.46, 0.0], [0.0, 0.46]] },
    { vehicle = 2, of = 2, gain = [[3.67, 0.0, -2.0, 0.0], [0.0, 3.67, 0.0, -2.0]] },
]
"""


def with_links(scenario: Scenario, **delays_s: float) -> Scenario:
    """The scenario over constant links with a delay each way of `all`, or of `v2` for vehicle 2, and so on."""
    vehicles = tuple(
        VehicleLinks(system_id=int(name[1:]), up=Link(delay_s=own_s), down=Link(delay_s=own_s))
        for name, own_s in delays_s.items()
        if name != "all"
    )
    both = Link(delay_s=delays_s["all"])
    links = scenario.links.model_copy(update={"up": both, "down": both, "vehicles": vehicles})
    return scenario.model_copy(update={"links": links})


def study_of(scenario: Scenario) -> Study:
    return Study(flight_plan(scenario.with_calm_monitor())[1])


def onset_of(scenario: Scenario, vehicle: int | None = None) -> Onset:
    return find_onset(study_of(scenario), lambda trials: list(map(fly_trial, trials)), tolerance=0.02, vehicle=vehicle)


def test_a_link_alone_breaks_its_loop_at_the_loops_margin() -> None:
    """The other vehicle's link differs, and clocks run at rates of their own."""
    onset = onset_of(with_links(SCENARIO, all=0.03, v2=0.06), 2)
    [leader, follower] = plan_loops(study_of(SCENARIO).plan)
    assert onset.predicted_s == pytest.approx(follower.margin_s())
    assert follower.margin_s() < 0.9 * leader.margin_s()
    assert onset.loop_delay_s == pytest.approx(onset.predicted_s, rel=2e-4)  # measured: 3e-5
    assert onset.link_delay_left_s == pytest.approx(onset.link_delay_s - 0.12)
    assert (onset.vehicle, onset.critical, onset.loop) == (2, 2, (2,))


def test_a_loop_with_unlike_links_breaks_where_its_model_does() -> None:
    """A platoon that looks back as well. A model without extrapolation is 13 % off."""
    scenario = with_links(load(located("chain3_bidirectional")), all=0.02)
    onset = onset_of(scenario, 2)
    assert onset.predicted_s is not None
    assert onset.loop == (1, 2, 3)
    assert onset.loop_delay_s > 1.3 * study_of(scenario).plan.delay_margin_s  # a single link may exceed the margin
    assert onset.loop_delay_s == pytest.approx(onset.predicted_s, rel=5e-4)  # measured: 1e-4
    assert onset.checks == ()  # there is no other loop
    assert [own.verdict for own in onset.own] == ["stable", "unstable"]  # both past the margin of equal links


def test_the_window_of_a_link_ends_where_growth_is_zero() -> None:
    plan = flight_plan(load(located("chain3_bidirectional")).with_calm_monitor())[1]
    for vehicle in (1, 2, 3):
        # a step of the search is 30 ms, and the growth rate changes by some 1.5 1/s a second here
        assert abs(growth_of(plan, vehicle)(window_of(plan, vehicle)[1])) < 1e-6


def test_the_vehicle_that_waits_is_the_slowest_of_its_loop() -> None:
    """Only its link jitters: the others wait for the tick alone."""
    late = Link(delay_s=0.1, jitter=Jitter(distribution="exponential", scale_s=0.04))
    scenario = with_links(load(located("chain3_bidirectional")), all=0.1, v3=0.1)
    links = scenario.links.model_copy(update={"vehicles": (VehicleLinks(system_id=3, up=late, down=late),)})
    study = study_of(scenario.model_copy(update={"links": links}))
    found = fly_trial(study.trial("probe", {"delay": 0.2}, seed=1))
    assert found.critical == 3
    assert known(found.waiting_s) > 0.06  # two mean jitters, and part of a period of 20 ms


def test_a_jittery_link_in_a_loop_moves_the_predicted_onset() -> None:
    """All links are slowed alike, but one vehicle waits longer: the margin for equal delays is 8 % off."""
    late = Link(delay_s=0.02, jitter=Jitter(distribution="uniform", scale_s=0.06))
    scenario = with_links(load(located("chain3_bidirectional")), all=0.02)
    own = VehicleLinks(system_id=3, up=late, down=late)
    onset = onset_of(scenario.model_copy(update={"links": scenario.links.model_copy(update={"vehicles": (own,)})}))
    assert (onset.critical, onset.loop) == (3, (1, 2, 3))
    assert onset.loop_delay_s > 1.05 * study_of(scenario).plan.delay_margin_s
    assert onset.loop_delay_s == pytest.approx(known(onset.predicted_s), abs=3.0 * onset.error_s)


def test_states_of_one_age_leave_one_delay_for_each_command() -> None:
    """The model in positions beside the one in errors, which has no ages."""
    [block] = plan_loops(study_of(load(located("chain3_bidirectional"))).plan)
    delays_s = dict(zip(block.system_ids, (0.25, 0.31, 0.2), strict=True))
    alike = dict.fromkeys(block.system_ids, 0.1)
    wanted_1_s = block.growth_continuous_at_1_s(delays_s)
    assert block.growth_continuous_at_1_s(delays_s, alike) == pytest.approx(wanted_1_s, rel=1e-9)
    older = alike | {2: 0.2}
    assert block.growth_continuous_at_1_s(delays_s, older) != pytest.approx(wanted_1_s, rel=1e-2)


def test_links_that_break_another_loop_leave_no_onset_to_find() -> None:
    with pytest.raises(NoOnset, match="the links of the scenario alone make vehicle 2 unstable"):
        onset_of(with_links(SCENARIO, all=0.03, v2=0.4), 1)


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (["--onset-of", "9"], "--onset-of: read 9, wanted one of the system ids 1 2 3"),
        (["--onset-of", "2", "--delay", "0.1"], "read --onset-of and --delay, wanted one of them"),
        (["--onset-of", "2", "--real-time"], "wanted a vehicle that shares its loop with no other"),
        (["--onset-of", "2", "--loop", "onboard"], "read 2 with loops on board, wanted a vehicle that shares"),
    ],
)
def test_options_without_an_onset_of_one_link_are_refused(options: list[str], wanted: str) -> None:
    result = CliRunner().invoke(app, ["stress", "chain3_bidirectional", *options])
    assert isinstance(result.exception, InputError)
    assert wanted in str(result.exception)


def test_the_link_of_an_external_leader_has_no_onset(tmp_path: Path) -> None:
    scenario = tmp_path / "led.toml"
    scenario.write_text(dump(SCENARIO.model_copy(update={"course": Course(leader="external")})), encoding="utf-8")
    result = CliRunner().invoke(app, ["stress", str(scenario), "--onset-of", "1"])
    assert str(result.exception) == "--onset-of: read 1, wanted one of the system ids 2"


def test_what_is_printed_names_the_vehicle_and_what_is_left(tmp_path: Path) -> None:
    out = tmp_path / "out"
    scenario = tmp_path / "pair.toml"
    scenario.write_text(dump(with_links(SCENARIO, all=0.03, v2=0.06)), encoding="utf-8")
    result = CliRunner().invoke(app, ["stress", str(scenario), "--onset-of", "2", "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "for vehicle 2 alone, +" in result.output
    assert "The link of vehicle 2 alone takes" in (out / "report.html").read_text(encoding="utf-8")


def test_a_check_has_the_headroom_of_each_vehicle() -> None:
    found = check(flight_plan(with_links(load(located("chain3")), all=0.02, v3=0.09))[1])
    assert [own.expected_loop_delay_s for own in found.vehicles] == pytest.approx([0.05, 0.05, 0.19])
    leader_s = plan_loops(study_of(load(located("chain3"))).plan)[0].margin_s()
    assert [own.link_delay_left_s for own in found.vehicles] == pytest.approx([leader_s - 0.05, 0.25, 0.11])
    assert found.headroom == found.vehicles[2].headroom == pytest.approx(0.11 / 0.3)


def test_loops_on_board_break_at_their_margin_over_different_links() -> None:
    scenario = with_links(load(located("thesis_delay")), all=0.05, v1=0.3)
    study = study_of(scenario)
    assert study.plan.delay_margin_s == pytest.approx(1.0022, abs=1e-4)
    margin_s = plan_over_links(study.plan).delay_margin_s
    assert margin_s == pytest.approx(1.0402, abs=5e-4)  # flown: 1.0402

    def flown(share: float) -> float | None:
        """The growth where all loop delays are this share of those at which it breaks."""
        factor = share * margin_s / 0.61
        each_way_s = [(factor * (2.0 * at_s + 0.01) - 0.01) / 2.0 for at_s in (0.05, 0.3)]
        trial = study_of(with_links(scenario, all=each_way_s[0], v1=each_way_s[1])).trial("probe", {}, seed=6)
        return fly_trial(trial).growth_1_s

    assert known(flown(0.98)) < -0.003
    assert known(flown(1.02)) > 0.01


def test_a_shared_loop_may_break_far_below_its_margin() -> None:
    """Both look at each other. If links are alike they take 630 ms of loop delay; one alone takes 363 ms."""
    scenario = with_links(parse(EACH_OTHER, Path("each_other.toml")), all=0.0, v2=0.285)
    design, plan = flight_plan(scenario)
    flown, plan_flown = over_own_links(design, plan)
    found = check(plan_flown)
    _, follower = found.vehicles
    assert plan.delay_margin_s > 0.6 > known(follower.expected_loop_delay_s)
    assert flown.delay_margin_s == plan_flown.delay_margin_s == pytest.approx(0.365, abs=0.005)
    assert found.headroom is not None
    assert found.headroom < -0.5
    assert known(follower.expected_loop_delay_s) + (follower.link_delay_left_s or 0.0) == pytest.approx(
        0.3635, abs=4e-3
    )
    onset = onset_of(scenario, 2)  # from a link that is past it
    assert onset.loop_delay_s == pytest.approx(onset.predicted_s, rel=2e-4)  # measured: 4e-5
    assert onset.link_delay_left_s is not None
    assert onset.link_delay_left_s < -0.2
    alike = flight_plan(with_links(scenario, all=0.1))
    assert over_own_links(*alike) == alike


def test_the_warning_of_links_that_differ_has_the_least_margin(tmp_path: Path) -> None:
    """A fast vehicle takes less than the slowest, whose margin stands for the formation's."""
    scenario, file = with_links(load(located("chain3_bidirectional")), all=0.02, v3=0.12), tmp_path / "unlike.toml"
    design, _ = over_own_links(*flight_plan(scenario))
    least_s = min(known(own.delay_margins_s[0]) for own in design.own_margins)
    assert least_s < 0.95 * known(design.delay_margin_s)
    file.write_text(dump(scenario), encoding="utf-8")
    result = CliRunner().invoke(app, ["check", str(file)])
    assert f"the least margin is {1e3 * least_s:.1f} ms" in result.stderr


def test_flight_and_headroom_agree_over_links_that_differ() -> None:
    """Below the margin of equal links one formation flies apart; past it, another is stable."""
    apart = fly_virtual(with_links(parse(EACH_OTHER, Path("each_other.toml")), all=0.0, v2=0.285)).summary
    assert (apart.verdict, apart.delay_margin_s) != ("stable", pytest.approx(0.63, abs=0.01))
    assert apart.headroom_min is not None
    assert apart.headroom_min < -0.5
    watched = load(located("chain3_bidirectional")).with_calm_monitor()
    together = fly_virtual(with_links(watched, all=0.02, v2=0.17)).summary
    assert together.verdict == "stable"
    assert together.headroom_min is not None
    assert 0.1 < together.headroom_min < 0.2
    assert together.loop_delay_s.max is not None
    assert together.loop_delay_s.max > flight_plan(watched)[1].delay_margin_s
