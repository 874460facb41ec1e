"""Loops whose vehicles have margins of their own: over links that differ, and where a leader hears nobody."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from gcs import fly_virtual
from gcs.drive.flown import fly_plan
from gcs.plan.planner import flight_plan, over_own_links
from gcs.preflight.check import check
from gcs.runs.summary import summarise
from scenarios.files import parse
from scenarios.keys.link import Link, VehicleLinks
from scenarios.schema import Scenario
from tests.support.known import known


def chain(blocks: Mapping[tuple[int, int], tuple[float, ...]], **control: object) -> Scenario:
    """Three vehicles in a chain; `blocks[i, j]` are the gains of u_i on e_j: spacing and velocity, on both axes."""
    vehicles = [
        f"{{ system_id = {k}, position_ne_m = [{-61 * (k - 1)}, {9.7 * (k - 1)}], velocity_ne_m_s = [20, 0]"
        + (f", follows = {k - 1}, offset_ne_m = [-60, 9]" if k > 1 else "")
        + " }"
        for k in (1, 2, 3)
    ]
    rows = [
        f"{{ vehicle = {i}, of = {j}, gain = [[{', '.join(f'{g}, 0.0' for g in gains)}], "
        f"[{', '.join(f'0.0, {g}' for g in gains)}]] }}"
        for (i, j), gains in blocks.items()
    ]
    keys = [f"{key} = {value!r}" for key, value in control.items()]
    text = [
        'name = "chain"\nseed = 1\nduration_s = 40.0',
        "nominal_velocity = [{ from_s = 0.0, velocity_ne_m_s = [20.0, 0.0] }]",
        f"vehicles = [{', '.join(vehicles)}]\n[control]",
        *keys,
        f"blocks = [{', '.join(rows)}]",
    ]
    return parse("\n".join(text), Path("chain.toml"))


def over(scenario: Scenario, each_way_s: float, **own_s: float) -> Scenario:
    """The scenario over links of a constant delay; `v2=` and so on give vehicles a delay of their own."""
    own = tuple(
        VehicleLinks(system_id=int(name[1:]), up=Link(delay_s=at_s), down=Link(delay_s=at_s))
        for name, at_s in own_s.items()
    )
    both = Link(delay_s=each_way_s)
    links = scenario.links.model_copy(update={"up": both, "down": both, "vehicles": own})
    return scenario.model_copy(update={"links": links})


QUICK_AND_SLOW = {
    (1, 1): (-2.0,),
    (2, 2): (6.0, -3.5),
    (2, 3): (-0.02, 0.02),
    (3, 2): (0.02, 0.02),
    (3, 3): (0.25, -0.8),
}
"""Vehicle 2 is quick and tolerates 290 ms; vehicle 3 is slow and tolerates more than a second."""


def test_a_quick_vehicle_keeps_its_margin_beside_a_slow_link() -> None:
    """In flight, vehicle 2 alone breaks the loop at 289.65 ms of loop delay."""
    scenario = over(chain(QUICK_AND_SLOW), 0.03, v3=0.25)
    plan = over_own_links(*flight_plan(scenario))[1]
    _, quick, slow = check(plan).vehicles
    assert plan.delay_margin_s == pytest.approx(0.7755, abs=1e-3)
    assert known(quick.headroom) == pytest.approx(1.0 - 0.07 / 0.2895, abs=5e-3)
    assert known(slow.headroom) == pytest.approx(1.0 - 0.51 / 1.4235, abs=5e-3)  # a monodromy matrix: 1.42348 s
    flown = fly_virtual(scenario).summary
    assert flown.verdict == "stable"
    assert known(flown.vehicles[1].headroom_min_s) == pytest.approx(0.2895 - 0.074, abs=0.01)


def test_the_monitor_slows_gains_before_a_quick_vehicle_breaks_them() -> None:
    """The links turn out slower than planned: in flight vehicle 2 has 350 ms."""
    plan = over_own_links(*flight_plan(over(chain(QUICK_AND_SLOW), 0.03, v3=0.25)))[1]
    late = over(plan.scenario, 0.03, v2=0.17, v3=0.25)
    design = flight_plan(plan.scenario)[0]
    for act, verdict in ((True, "stable"), (False, "unstable")):
        monitor = late.monitor.model_copy(update={"act": act})
        slower = replace(plan, scenario=late.model_copy(update={"monitor": monitor}))
        flight = fly_plan(slower)
        assert summarise(slower.scenario, design, flight.ticks, flight.events).verdict == verdict


def test_a_slow_vehicle_of_a_tree_keeps_its_own_margin() -> None:
    """Without the coupling of `QUICK_AND_SLOW` vehicle 3 closes its own loop, whose margin is far above vehicle 2's."""
    tree = {(i, j): gains for (i, j), gains in QUICK_AND_SLOW.items() if i == j}
    scenario = over(chain(tree), 0.03, v3=0.25)
    slow = check(over_own_links(*flight_plan(scenario))[1]).vehicles[2]
    left_s = known(slow.link_delay_left_s)
    assert known(slow.headroom) == pytest.approx(left_s / (0.51 + left_s), abs=1e-3)
    flown = fly_virtual(scenario).summary
    assert flown.verdict == "stable"
    assert not [each for each in flown.mode_changes if "CRITICAL" in each.text]


def test_a_shared_loop_is_not_judged_by_a_vehicle_outside() -> None:
    """Vehicles 1 and 2 share a loop over different links; vehicle 3 has a loop of its own with a shorter margin."""
    shared = {(1, 1): (-2.0,), (1, 2): (-0.02, 0.02), (2, 1): (0.02,), (2, 2): (0.25, -0.8)}
    scenario = over(chain(shared | {(3, 3): (6.0, -3.5)}), 0.01, v2=0.25)
    slow = check(over_own_links(*flight_plan(scenario))[1]).vehicles[1]
    alone = over(chain(shared | {(3, 3): (0.25, -0.8)}), 0.01, v2=0.25)
    assert slow.headroom == check(over_own_links(*flight_plan(alone))[1]).vehicles[1].headroom


def test_a_predicted_leader_that_hears_nobody_has_no_limit() -> None:
    blocks = {(1, 1): (-2.0,), (2, 2): (1.0, -1.0), (2, 3): (-1.0, 0.9), (3, 2): (1.0, 0.9), (3, 3): (1.0, -1.0)}
    scenario = over(chain(blocks, loop="onboard", prediction=0.4), 0.195)
    flown = fly_virtual(scenario).summary
    assert flown.verdict == "stable"
    assert flown.vehicles[0].headroom_min == 1.0
    assert known(flown.headroom_min) > 0.9
    assert known(flown.loop_delay_bound_s) > 0.3  # of two clocks, over links that may be slower one way
