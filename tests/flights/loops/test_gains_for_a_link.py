"""Gains of the front and gains for measured links: their figures hold in other code and in flight."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from gains.performance.scalar_gains import PAIR, ScalarGains
from gains.sampled.constant import growth_rate, sampled_delay_margin
from gcs.cli.front import chosen_for
from gcs.errors import InputError
from gcs.plan.design import Design, GainsAtDelay, LinkPart
from gcs.plan.planner import flight_plan
from gcs.stress.axes import at_coordinates
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from gcs.studies.front import compared, point_at, searched_in
from gcs.studies.virtual import fly_virtual
from gcs.views.report import print_design
from gcs.watch.before_flight import measured_now
from gcs.watch.for_link import best_for, evaluated
from scenarios.errors import ScenarioError
from scenarios.files import checked, load
from scenarios.keys.link import Jitter, Link, Links, VehicleLinks
from scenarios.schema import Control, Criteria, Response, Scenario
from tests.support.fleets.logged_flight import flown, log_bytes
from tests.support.fleets.own_code import coded
from tests.support.known import known
from tests.support.paths import SCENARIOS

CHAIN = load(SCENARIOS / "chain3.toml").model_copy(update={"duration_s": 5.0})
LINK_S = 0.2
PERIOD_S = 0.02


@cache
def logged() -> tuple[bytes, float]:
    """A log over links of 0.2 s each way, and the loop delay that the station measured there."""
    _, summary, _, entries = flown(at_coordinates(CHAIN, {"delay": 2.0 * LINK_S}).with_calm_monitor())
    return log_bytes(entries), known(summary.loop_delay_s.p50)


@pytest.fixture(scope="module")
def chosen(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scenario, LinkPart]:
    file = tmp_path_factory.mktemp("log") / "flight.tlog"
    file.write_bytes(logged()[0])
    scenario, part = chosen_for(CHAIN, file)
    assert part is not None
    return scenario, part


@pytest.mark.parametrize("predict", ["off", "on"])
def test_a_point_of_the_front_decays_in_flight_as_computed(predict: str) -> None:
    delay_s = 0.4
    way = "on" if predict == "on" else "off"
    scenario, point = point_at(
        CHAIN, delay_s, "inclusion", "alpha_at_delay", way
    )  # the fastest gains have a multiple root
    plan = flight_plan(scenario.with_calm_monitor())[1]
    assert point.stable_s is not None
    least_s, most_s = point.stable_s
    assert least_s <= 0.8 * delay_s
    assert known(most_s) >= 1.2 * delay_s
    if predict == "off":  # the margin of the whole formation, both axes
        margin_s = float(sampled_delay_margin(plan.model.A, plan.model.B, plan.gain, period_s=PERIOD_S))
        assert most_s == pytest.approx(margin_s, rel=1e-9)
    study, link_s = Study(plan), delay_s - PERIOD_S / 2.0
    beside = fly_trial(study.trial("probe", {"delay": link_s}, seed=1, probe=2))
    outcome = fly_trial(study.trial("probe", {"delay": link_s + delay_s - known(beside.loop_delay_s)}, seed=1, probe=2))
    assert outcome.loop_delay_s == pytest.approx(delay_s, abs=1e-4)
    # without prediction the point's decay is that of the continuous loop, which differs in the square of the period
    assert -known(outcome.growth_1_s) == pytest.approx(known(point.decay_rate_1_s), rel=0.03)


def test_the_delay_of_a_log_is_what_the_station_measured(chosen: tuple[Scenario, LinkPart]) -> None:
    """Within half a period: the phase of telemetry between two ticks is random, and constant during a flight."""
    part = chosen[1]
    assert part.loop_delay_s_p50 == pytest.approx(logged()[1], abs=PERIOD_S / 2.0)
    assert part.loop_delay_s_least < part.loop_delay_s_p50 < part.loop_delay_s_worst
    assert part.vehicles == (1, 2, 3)


def test_what_is_chosen_for_a_link_beats_the_default_there(chosen: tuple[Scenario, LinkPart]) -> None:
    """The default design asks for a margin of 0.3 s, less than this delay."""
    scenario, part = chosen
    ends_s = part.loop_delay_s_least, part.loop_delay_s_worst
    matrices = flight_plan(CHAIN)[0].inclusion_gains
    assert matrices is not None
    K1, K2, K3 = (gain[0][0] for gain in matrices)
    default = evaluated(ScalarGains(-K1, K2, K3, 0.0), PERIOD_S, None, ends_s)
    for own in part.candidates:
        assert known(own.alpha) > known(default.alpha)
        assert known(own.headroom) >= part.headroom > known(default.headroom)
    best = max(part.candidates, key=lambda own: known(own.alpha))
    assert scenario.control.prediction == ("measured" if best.prediction else "off")
    settled = flown(at_coordinates(scenario, {"delay": 2.0 * LINK_S}))[1]
    assert settled.verdict == "stable"
    assert known(settled.headroom_min) >= part.headroom


def test_a_flight_keeps_the_headroom_that_was_asked_for() -> None:
    """Late or lost states lengthen the loop delay, but their age is known, so there is no mismatch."""
    link = Link(delay_s=0.2, jitter=Jitter(distribution="uniform", scale_s=0.03), loss_probability=0.05)
    control = Control(for_link="measured", string_peak_max=1.0)
    scenario = CHAIN.model_copy(update={"links": Links(up=link, down=link), "control": control, "duration_s": 20.0})
    flight = fly_virtual(scenario)
    part = flight.design.for_link
    assert part is not None
    assert "with prediction: alpha" in part.chosen
    assert part.headroom < known(flight.summary.headroom_min) < 0.8  # 0.60
    assert np.nanmax(flight.loop_delay_s - flight.ticks["assumed_delay_s"]) > 0.08  # of 0.10 s tolerated


@pytest.mark.slow(first=0)
def test_short_delays_get_gains_though_long_ones_allow_none() -> None:
    """Gains for the 20 ms links of chain3 are so fast that a prediction over 3 s would tolerate only 1 ms."""
    flight = fly_virtual(CHAIN.model_copy(update={"control": Control(for_link="measured"), "duration_s": 2.0}))
    assert flight.summary.verdict == "stable"
    assert flight.design.prediction is not None
    assert [at.assumed_delay_s for at in flight.design.prediction.windows] == [0.1]


def test_a_log_without_exchanges_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "short.tlog"
    file.write_bytes(logged()[0][:4000])
    with pytest.raises(InputError, match=r"--links-of: .*short.tlog: read 0, wanted 10 delays each way"):
        chosen_for(CHAIN, file)


def test_a_scenario_for_measured_links_is_not_designed_without_them() -> None:
    scenario = CHAIN.model_copy(update={"control": Control(for_link="measured")})
    with pytest.raises(
        InputError, match=r"control.for_link: read measured, wanted measured links: gcs fly measures them"
    ):
        flight_plan(scenario)
    control = Control(for_link="measured", delay_margin_s=0.3)
    with pytest.raises(ScenarioError, match=r"control.for_link"):
        checked(CHAIN.model_copy(update={"control": control}), Path("chain3.toml"))


def test_gains_for_links_are_refused_for_vehicles_of_unknown_response() -> None:
    late = coded(dynamics="lagged").model_copy(update={"control": Control()})
    with pytest.raises(
        InputError, match=r"read dynamics own.py:lagged, wanted a \[response\], which gcs identify finds"
    ):
        searched_in(late, ("inclusion",))
    for_link = late.model_copy(update={"control": Control(for_link="measured")})
    with pytest.raises(
        ScenarioError, match=r"for_link: read 'measured', wanted off, with dynamics own.py:lagged, or a \[response\]"
    ):
        checked(for_link, Path("own.toml"))
    known = {"response": Response(lag_s=0.2)}
    with pytest.raises(InputError, match=r"read graph-lqr and a \[response\], wanted --method inclusion"):
        searched_in(late.model_copy(update=known), ("inclusion", "graph-lqr"))
    checked(for_link.model_copy(update=known), Path("own.toml"))
    damped = Control(for_link="measured", criteria=Criteria(maximise="decay_rate_1_s", damping_min=0.7))
    with pytest.raises(ScenarioError, match=r"damping_min: read 0.7, wanted no such key with dynamics own.py:lagged"):
        checked(for_link.model_copy(update=known | {"control": damped}), Path("own.toml"))


def test_links_measured_before_a_flight_have_its_logs_delays() -> None:
    jitter = Jitter(distribution="uniform", scale_s=0.03)
    links = Links(up=Link(delay_s=0.2, jitter=jitter, loss_probability=0.05), down=Link(delay_s=0.1))
    scenario = CHAIN.model_copy(update={"control": Control(for_link="measured"), "links": links})
    before = measured_now(scenario, None, start_vehicles=False, key_file=None, shown=False)
    assert before.vehicles == (1, 2, 3)
    flown_s = flown(CHAIN.model_copy(update={"links": links}).with_calm_monitor())[1].loop_delay_s
    assert before.loop_delay_s_p50 == pytest.approx(known(flown_s.p50), abs=PERIOD_S / 2.0)
    # a clock error shifts delay from one way to the other, so only their sum is compared: the spread of both ways
    assert before.loop_delay_s_worst - before.loop_delay_s_least == pytest.approx(2 * 0.03 + PERIOD_S, rel=0.25)


def test_losses_of_measured_links_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    lossy = VehicleLinks(system_id=3, up=Link(delay_s=0.02, loss_probability=0.4))
    links = CHAIN.links.model_copy(update={"vehicles": (lossy,)})
    for own, share in ((links, 0.4), (CHAIN.links, 0.0)):
        scenario = CHAIN.model_copy(update={"control": Control(for_link="measured"), "links": own})
        part = measured_now(scenario, None, start_vehicles=False, key_file=None, shown=False)
        assert part.lost_share == pytest.approx(share, abs=0.1)
        chosen, part = best_for(scenario, part)
        print_design(flight_plan(chosen)[0].model_copy(update={"for_link": part}))
        told = f"losses   {part.lost_share:.0%} of a vehicle's datagrams were lost"
        assert (told in capsys.readouterr().out) == (share > 0.0)


def test_links_that_cannot_be_measured_before_a_flight_are_refused() -> None:
    deaf = VehicleLinks(system_id=3, down=Link(delay_s=0.02, loss_probability=1.0))
    links = CHAIN.links.model_copy(update={"vehicles": (deaf,)})
    scenario = CHAIN.model_copy(update={"control": Control(for_link="measured"), "links": links})
    with pytest.raises(InputError, match=r"chain3: control.for_link: read too few TIMESYNC exchanges with vehicle 3, "):
        measured_now(scenario, None, start_vehicles=False, key_file=None, shown=False)


def test_a_delay_that_no_gains_tolerate_is_refused() -> None:
    """Margins are designed up to 30 s, and the station predicts over 10 s at most."""
    delays = LinkPart(
        source="log", vehicles=(1,), loop_delay_s_least=22.0, loop_delay_s_p50=23.0, loop_delay_s_worst=24.0,
        headroom=0.3,
    )  # fmt: skip
    with pytest.raises(
        InputError, match=r"control.for_link: read a loop delay of 24000.0 ms from log, wanted one that"
    ):
        best_for(CHAIN, delays)


def static_decay_1_s(way: GainsAtDelay, first: float = 1.0, last: float = 1.0, *, share: float = 1.0) -> float:
    """Decay rate of the sampled loop, with K1 times `first` and K3 times `last`, at a share of the delay."""
    K = ScalarGains(-first * known(way.K1), 0.0, last * known(way.K3), 0.0).K
    return -growth_rate(PAIR.A, PAIR.B, K, period_s=PERIOD_S, delay_s=share * way.loop_delay_s)


def test_prediction_tolerates_longer_delays_at_equal_decay() -> None:
    """Two static gains tolerate (2 - sqrt 2) / decay at most: docs/explanation/prediction.md."""
    design = flight_plan(load(SCENARIOS / "triangle5.toml"))[0]
    plain, *predicted = compared(design, "triangle5").ways
    decays = [known(way.decay_rate_1_s) for way in predicted]
    assert decays == pytest.approx([known(plain.decay_rate_1_s)] * len(predicted), rel=1e-3)
    assert {way.string_peak for way in (plain, *predicted)} == {1.0}
    *least, own = predicted
    assert [way.tolerated for way in least if known(way.ratio) > 5.0] == [0.05, 0.03]
    [alike] = [way for way in least if way.tolerated == own.tolerated]
    assert known(own.ratio) < 5.0 < known(alike.ratio)
    assert all(known(way.noise_gain) > 4.0 * known(plain.noise_gain) for way in predicted)
    assert all(known(way.spacing_gain_s2) > known(plain.spacing_gain_s2) for way in predicted)
    assert all(known(way.alpha) < known(plain.alpha) for way in predicted)
    near = 0.99975143, 0.99941735  # the best of a simplex search with the sampled loop
    decays = (static_decay_1_s(plain, share=1.1), static_decay_1_s(plain), static_decay_1_s(plain, *near))
    assert decays == pytest.approx((1.08, 1.62, 1.73), abs=0.005)  # the figures of that page
    assert max(known(way.decay_rate_half_way_1_s) for way in predicted) < 0.65
    with pytest.raises(InputError, match=r"wanted one by inclusion"):
        compared(Design(delay_margin_s=1.0), "other")
    with pytest.raises(InputError, match=r"and \[response\] if vehicles have an autopilot"):
        compared(flight_plan(load(SCENARIOS / "copters5.toml"))[0], "copters5")
