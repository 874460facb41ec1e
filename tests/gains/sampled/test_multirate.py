"""Telemetry and control at different rates: the lifted map and its margin against a simulation event by event."""

from itertools import pairwise
from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from gains.core.errors import BadModelError
from gains.sampled._loop import HeldPlant
from gains.sampled.constant import growth_rate
from gains.sampled.multirate import Timing, lifted_radius, multirate_delay_margin, multirate_growth_rate, multirate_map
from gcs.stress.growth import Motion, fit_growth

Matrix = NDArray[np.float64]
Loop = tuple[Matrix, Matrix, Matrix]

FOLLOWER: Loop = (np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, -1.0]]))
TWO_INPUTS: Loop = (
    np.array([[-0.3, 1.0, 0.2], [-2.0, 0.1, 0.0], [0.5, 0.0, -1.0]]),
    np.array([[0.0, 1.0], [1.0, 0.0], [0.3, -0.4]]),
    np.array([[0.4, -0.8, 0.1], [-0.5, 0.2, 0.3]]),
)
STEPS: dict[tuple[int, float], Matrix] = {}
FIVE_TO_TWO = Timing(control_s=0.05, telemetry_s=0.02)
RATES = [FIVE_TO_TWO, Timing(0.02, 0.05), Timing(0.03, 0.04), Timing(0.04, 0.03), Timing(0.02, 0.1), Timing(0.1, 0.02)]


def advanced(loop: Loop, x: Matrix, u: Matrix, duration_s: float) -> Matrix:
    """x after `duration_s` with u held, by SciPy's matrix exponential."""
    A, B, _ = loop
    n, inputs = B.shape
    key = id(loop), round(duration_s, 9)
    if key not in STEPS:
        generator = np.zeros((n + inputs, n + inputs))
        generator[:n, :n], generator[:n, n:] = A, B
        STEPS[key] = np.asarray(expm(duration_s * generator), dtype=np.float64)
    return (STEPS[key] @ np.concatenate([x, u]))[:n]


def flown(
    loop: Loop, timing: Timing, x0: Matrix, end_s: float, *, phase_s: float = 0.0, up_s: float = 0.0, down_s: float
) -> tuple[Matrix, float]:
    """States at multiples of the common period, and the mean loop delay of commands that are the first from a sample.

    Samples, messages and commands are a list of events in time, without any matrix of the map. Nothing is sent before
    zero.
    """
    _, B, K = loop
    events: list[tuple[float, int, str]] = []
    for i in range(round(end_s / timing.telemetry_s) + 1):
        taken_s = phase_s + i * timing.telemetry_s
        events += [(taken_s, i, "0 sample"), (taken_s + up_s, i, "1 arrive")]
    for j in range(round(end_s / timing.control_s) + 1):
        events += [(j * timing.control_s, j, "2 compute"), (j * timing.control_s + down_s, j, "3 act")]
    events += [(k * timing.common_s, k, "4 look") for k in range(round(end_s / timing.common_s) + 1)]
    now_s, x, u = 0.0, x0, np.zeros(B.shape[1])
    sent: dict[int, tuple[int, Matrix]] = {}
    commands: dict[int, tuple[int, Matrix]] = {}
    newest = -1, np.zeros(B.shape[1])
    seen: list[Matrix] = []
    first_uses: dict[int, float] = {}
    for instant_s, kind, number in sorted((round(t, 9), kind, number) for t, number, kind in events):
        if instant_s > end_s + 1e-9:
            break
        x, now_s = advanced(loop, x, u, instant_s - now_s), instant_s
        if kind == "0 sample":
            sent[number] = number, K @ x
        elif kind == "1 arrive":
            newest = sent[number]
        elif kind == "2 compute":
            commands[number] = newest
        elif kind == "3 act":
            sample, u = commands[number]
            if sample >= 0:
                first_uses.setdefault(sample, instant_s - phase_s - sample * timing.telemetry_s)
        else:
            seen.append(x)
    whole = len(first_uses) // timing.commands * timing.commands
    return np.array(seen).astype(np.float64), float(np.mean(list(first_uses.values())[:whole]))


@pytest.mark.parametrize("loop", [FOLLOWER, TWO_INPUTS], ids=["follower", "two inputs"])
@pytest.mark.parametrize("timing", RATES, ids=str)
@pytest.mark.parametrize("least_s", [0.0, 0.047, 0.33])
def test_map_predicts_what_is_flown(loop: Loop, timing: Timing, least_s: float) -> None:
    plant = HeldPlant(*loop, period_s=timing.common_s)
    Phi = multirate_map(plant, timing, delay_s=least_s + timing.spread_s)
    x0 = np.array([1.0, -0.5, 0.3])[: len(loop[0])]
    state = np.concatenate([x0, np.zeros(len(Phi) - len(x0))])
    states, _ = flown(loop, timing, x0, 8 * timing.common_s, down_s=least_s)
    for sample in states:
        # instants of the simulation are rounded to a nanosecond
        assert state[: len(x0)] == pytest.approx(sample, abs=1e-7)
        state = Phi @ state


@pytest.mark.parametrize(("phase_s", "up_s"), [(0.004, 0.0), (0.013, 0.31), (0.0, 0.6)])
@pytest.mark.parametrize("timing", RATES, ids=str)
def test_only_the_mean_loop_delay_counts_whatever_phase_and_share(timing: Timing, phase_s: float, up_s: float) -> None:
    """Growth of a flight of 20 s, against the map at the mean loop delay that it had."""
    states, mean_s = flown(FOLLOWER, timing, np.array([1.0, 0.0]), 20.0, phase_s=phase_s, up_s=up_s, down_s=0.037)
    found = fit_growth(
        Motion(timing.common_s * np.arange(len(states), dtype=np.float64), states, timing.common_s), start_s=4.0
    )
    assert found is not None
    model = multirate_growth_rate(*FOLLOWER, timing, delay_s=mean_s)
    # a tenth of a period of loop delay is 2e-3 and more; the fit leaves some 1e-5
    assert found.growth_1_s == pytest.approx(model, abs=1e-4)


@given(control_hz=st.floats(1.0, 500.0), telemetry_hz=st.floats(1.0, 500.0))
def test_any_rates_have_a_common_period_that_is_nearly_theirs(control_hz: float, telemetry_hz: float) -> None:
    timing = Timing(1.0 / control_hz, 1.0 / telemetry_hz)
    assert 1 <= timing.commands <= 20
    # no worse than half of 1 / 20 of the faster period, a slower period long
    faster_s = min(timing.control_s, timing.telemetry_s)
    assert timing.faster_s == pytest.approx(faster_s, rel=0.05)
    for (taken_s, computed_s), (_, following_s) in pairwise(timing.commands_from(0, 2 * timing.commands)):
        assert -1e-9 <= computed_s - taken_s < timing.faster_s
        assert following_s > computed_s
    means = [computed_s - taken_s for taken_s, computed_s in timing.commands_from(0, timing.commands - 1)]
    assert np.mean(means) == pytest.approx(timing.spread_s, abs=1e-9)


@pytest.mark.parametrize("delay_s", [0.0, 0.03, 0.1, 0.23, 0.3])
@pytest.mark.parametrize(("control_s", "telemetry_s"), [(0.1, 0.1), (0.1, 0.025), (0.02, 0.1)])
def test_whole_ratios_are_the_sampled_loop_with_the_slower_period(
    delay_s: float, control_s: float, telemetry_s: float
) -> None:
    """The map of events and that of `gains.sampled.constant`, which share no formula."""
    timing, plant = Timing(control_s, telemetry_s), HeldPlant(*TWO_INPUTS, period_s=0.1)
    alone = growth_rate(*TWO_INPUTS, period_s=0.1, delay_s=delay_s)
    events = np.log(lifted_radius(plant, timing, delay_s=delay_s)) / timing.common_s
    assert events == pytest.approx(alone, rel=1e-9)
    assert multirate_growth_rate(*TWO_INPUTS, timing, delay_s=delay_s) == alone


@pytest.mark.parametrize("timing", RATES[:4], ids=str)
def test_growth_is_zero_at_the_margin_and_negative_before(timing: Timing) -> None:
    margin_s = multirate_delay_margin(*FOLLOWER, timing)
    assert 0.6 < margin_s < 0.72
    delays_s = np.linspace(0.0, margin_s * (1.0 - 1e-6), 150).tolist()
    assert all(multirate_growth_rate(*FOLLOWER, timing, delay_s=delay_s) < 0.0 for delay_s in delays_s)
    assert multirate_growth_rate(*FOLLOWER, timing, delay_s=margin_s * (1.0 + 1e-6)) >= 0.0


@pytest.mark.parametrize(
    ("rates_hz", "gains", "crossings_s"),
    [((9, 4), (2.729, -2.871), (0.27286, 0.28840, 0.30606)), ((9, 7), (3.871, -2.8508), (0.29677, 0.30148, 0.30466))],
)
def test_the_first_of_several_crossings_within_one_step_counts(
    rates_hz: tuple[int, int], gains: tuple[float, float], crossings_s: tuple[float, float, float]
) -> None:
    loop, timing = (*FOLLOWER[:2], np.array([gains])), Timing(1.0 / rates_hz[0], 1.0 / rates_hz[1])
    assert multirate_delay_margin(*loop, timing) == pytest.approx(crossings_s[0], abs=1e-5)
    ends_s = (0.9 * crossings_s[0], *crossings_s, 1.05 * crossings_s[2])
    for k, (after_s, before_s) in enumerate(pairwise(ends_s)):
        delay_s = (after_s + before_s) / 2.0
        assert (multirate_growth_rate(*loop, timing, delay_s=delay_s) > 0.0) == (k % 2 == 1)
        states, _ = flown(loop, timing, np.array([1.0, 0.0]), 80.0, down_s=delay_s - timing.spread_s)
        early, late = (np.linalg.norm(states[at : at + 20], axis=0).max() for at in (20, 60))
        assert (late > early) == (k % 2 == 1)


def test_at_the_mean_loop_delay_uneven_rates_hardly_matter() -> None:
    """To second order the margin of uneven rates is that of the slower one; by the least delay it would be 4 ms off."""
    for telemetry_s in (0.045, 0.04, 0.03, 0.0333):
        even_s = multirate_delay_margin(*FOLLOWER, Timing(0.05, 0.05))
        assert multirate_delay_margin(*FOLLOWER, Timing(0.05, telemetry_s)) == pytest.approx(even_s, abs=3e-4)


def test_long_margins_are_those_of_the_mean_loop_delay() -> None:
    """The order of the loop delays accounts for a part in 10^4; at 100,000 periods a map would be far too large."""
    timing = Timing(1.0 / 59.91, 1.0 / 124.5)
    margin_s = multirate_delay_margin(*FOLLOWER, timing)
    assert margin_s > 30.0 * timing.held_s
    for factor, stable in ((1.0 - 2e-4, True), (1.0 + 2e-4, False)):
        assert (multirate_growth_rate(*FOLLOWER, timing, delay_s=factor * margin_s) < 0.0) == stable
    weak = multirate_delay_margin([[0.0]], [[1.0]], [[-1e-3]], timing)
    assert weak == pytest.approx(500.0 * np.pi - timing.held_s / 2.0, rel=1e-6)


def test_slower_telemetry_costs_margin() -> None:
    margins_s = [multirate_delay_margin(*FOLLOWER, Timing(0.1, 0.1 * k)) for k in (1, 1.5, 2, 3, 6)]
    assert all(faster > slower for faster, slower in pairwise(margins_s))


def test_unstable_loops_have_no_margin_and_weak_ones_no_limit() -> None:
    for timing in (Timing(0.1, 0.05), FIVE_TO_TWO):
        assert multirate_delay_margin([[1.0]], [[1.0]], [[-0.5]], timing) == 0.0
        assert multirate_delay_margin([[-1.0]], [[1.0]], [[-0.5]], timing) == inf
        assert multirate_delay_margin([[-1.0]], [[1.0]], [[0.0]], timing) == inf


@pytest.mark.parametrize(("control_s", "telemetry_s", "named"), [(0.0, 1.0, "control_s"), (1.0, inf, "telemetry_s")])
def test_wrong_timing_is_named(control_s: float, telemetry_s: float, named: str) -> None:
    with pytest.raises(BadModelError, match=named):
        Timing(control_s, telemetry_s)
