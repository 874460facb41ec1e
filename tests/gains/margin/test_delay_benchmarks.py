"""Published loops with known critical delays; `data/delay_benchmarks.json` names the source of each.

`expected` is the number as published, `computed` and `critical_pairs` are the same to full precision, recomputed by
other programs. Where the published number is rounded or wrong the entry's notes say so.
"""

import json
from math import inf
from typing import Any

import pytest

from gains.delay.constant import analyse_delay, delay_margin
from gains.delay.rightmost import rightmost_root
from gains.delay.sweep import frequency_sweep_margin
from gains.margin.opinions import checked_delay_margin
from gains.sampled._period import analyse_period
from tests.support.paths import DATA

BENCHMARKS: list[dict[str, Any]] = json.loads((DATA / "delay_benchmarks.json").read_text())

# the reference figures are good to 14 digits; the loops' own conditioning takes a few
RELATIVE = 1e-12


def of_kind(*kinds: str, longest_s: float = inf) -> Any:
    chosen = [entry for entry in BENCHMARKS if entry["kind"] in kinds]
    chosen = [entry for entry in chosen if longest_s == inf or entry["computed"][0] <= longest_s]
    assert chosen
    return pytest.mark.parametrize("entry", chosen, ids=[entry["name"] for entry in chosen])


@of_kind("margin", "delay_independent")
def test_margin_is_the_published_one(entry: dict[str, Any]) -> None:
    expected = float(entry["expected"])
    # printed to 3 digits at least
    assert delay_margin(entry["A0"], entry["A1"]) == pytest.approx(expected, rel=1e-4)


@of_kind("margin")
def test_margin_has_all_digits(entry: dict[str, Any]) -> None:
    analysis = analyse_delay(entry["A0"], entry["A1"])
    assert analysis.delay_margin_s == pytest.approx(entry["computed"][0], rel=RELATIVE)
    assert not analysis.delay_independent


@of_kind("delay_independent")
def test_delay_independent_loops_have_no_crossing(entry: dict[str, Any]) -> None:
    analysis = analyse_delay(entry["A0"], entry["A1"])
    assert analysis.delay_independent
    assert analysis.crossings == ()
    assert analysis.stable_intervals_s == ((0.0, inf),)


@of_kind("margin", "windows", "windows_open_at_0")
def test_windows_of_stability_are_complete(entry: dict[str, Any]) -> None:
    analysis = analyse_delay(entry["A0"], entry["A1"])
    assert len(analysis.stable_intervals_s) == len(entry["intervals"])
    for window, expected in zip(analysis.stable_intervals_s, entry["intervals"], strict=True):
        assert window == pytest.approx(tuple(expected), rel=RELATIVE)
    assert analysis.delay_margin_s == pytest.approx(entry["delay_margin_from_0"], rel=RELATIVE)
    assert analysis.unstable_roots_at_zero_delay == entry["unstable_roots_at_tau0"]


@of_kind("margin", "windows")
def test_crossings_are_complete(entry: dict[str, Any]) -> None:
    analysis = analyse_delay(entry["A0"], entry["A1"])
    pairs = [(crossing.delay_s, crossing.omega_rad_s) for crossing in analysis.crossings]
    expected = sorted((pair["tau0"], pair["omega"]) for pair in entry["critical_pairs"])
    assert pairs == [pytest.approx(pair, rel=RELATIVE) for pair in expected]


# without the loops that take more than 20 s: hundreds of radians of delay make the discretised spectrum take seconds
@of_kind("margin", "windows", longest_s=20.0)
def test_crossing_directions_are_those_of_the_rightmost_root(entry: dict[str, Any]) -> None:
    # only the first critical delay of a loop is sure to be a crossing of its rightmost root
    first = analyse_delay(entry["A0"], entry["A1"]).crossings[0]
    before, after = (
        rightmost_root([(entry["A0"], 0.0), (entry["A1"], first.delay_s * factor)]).real for factor in (0.999, 1.001)
    )
    assert first.direction == (1 if after > before else -1)
    assert (before < 0.0) != (after < 0.0)


def test_oscillator_is_stabilised_by_any_small_delay() -> None:
    [entry] = [entry for entry in BENCHMARKS if entry["kind"] == "windows_open_at_0"]
    analysis = analyse_delay(entry["A0"], entry["A1"])
    at_zero = analysis.crossings[0]
    # s^2 + 1 - 0.4 e^{-s tau}: roots +-j sqrt(0.6) without delay, to the left with it
    assert (at_zero.delay_s, at_zero.direction) == (0.0, -1)
    assert at_zero.omega_rad_s == pytest.approx(0.6**0.5, rel=RELATIVE)


@of_kind("margin", "delay_independent")
def test_frequency_sweep_agrees(entry: dict[str, Any]) -> None:
    expected = float(entry["computed"][0] if entry["kind"] == "margin" else entry["computed"])
    assert frequency_sweep_margin(entry["A0"], entry["A1"]) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(
    "name", ["classic_2x2", "double_integrator_PD_kp1_kd1", "lfc_one_area_KP0_KI1", "grounded_ring_consensus_n9"]
)
def test_three_opinions_agree(name: str) -> None:
    [entry] = [entry for entry in BENCHMARKS if entry["name"] == name]
    assert checked_delay_margin(entry["A0"], entry["A1"]) == pytest.approx(entry["computed"][0], rel=RELATIVE)


@of_kind("rightmost_root")
def test_rightmost_root_with_three_delays(entry: dict[str, Any]) -> None:
    root = rightmost_root(list(zip(entry["A"], entry["delays"], strict=True)))
    real, imaginary = entry["computed"]
    assert root == pytest.approx(complex(real, imaginary), rel=RELATIVE)


@of_kind("multi_delay")
def test_rightmost_root_is_on_the_axis_at_the_critical_delays(entry: dict[str, Any]) -> None:
    shares = {"[0, tau/2, tau]": (0.0, 0.5, 1.0), "[0,h,2h,3h]": (0.0, 1.0, 2.0, 3.0)}[entry["delays"]]
    for critical_s in entry["computed"]:
        delays = [share * critical_s for share in shares]
        # 1e-12 of |s| near 1, the accuracy of the reference delay
        assert abs(rightmost_root(list(zip(entry["A"], delays, strict=True))).real) < 1e-12


@of_kind("sampled_data_periodic")
def test_largest_sampling_period(entry: dict[str, Any]) -> None:
    assert analyse_period(entry["A"], entry["B"], entry["K"]).limit_s == pytest.approx(
        entry["computed"][0], rel=RELATIVE
    )
    # the loop's constant-delay margin, quoted in the notes to 7 digits
    B, K = entry["B"], entry["K"]
    A1 = [[b[0] * k for k in K[0]] for b in B]
    assert delay_margin(entry["A"], A1) == pytest.approx(1.167144, rel=1e-6)
