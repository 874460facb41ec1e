"""Telemetry and control at different rates: the lifted map against a simulation event by event, and its margin."""

from itertools import pairwise
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from gains.errors import BadModelError
from gains.multirate import Timing, multirate_delay_margin, multirate_map, multirate_spectral_radius
from gains.sampled import sampled_delay_margin, spectral_radius

Matrix = NDArray[np.float64]
Loop = tuple[Matrix, Matrix, Matrix]

FOLLOWER: Loop = (np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, -1.0]]))
TWO_INPUTS: Loop = (
    np.array([[-0.3, 1.0, 0.2], [-2.0, 0.1, 0.0], [0.5, 0.0, -1.0]]),
    np.array([[0.0, 1.0], [1.0, 0.0], [0.3, -0.4]]),
    np.array([[0.4, -0.8, 0.1], [-0.5, 0.2, 0.3]]),
)


def advanced(loop: Loop, x: Matrix, u: Matrix, duration_s: float) -> Matrix:
    """x after `duration_s` with u held, by SciPy's matrix exponential."""
    A, B, _ = loop
    n, inputs = B.shape
    generator = np.zeros((n + inputs, n + inputs))
    generator[:n, :n], generator[:n, n:] = A, B
    return (expm(duration_s * generator) @ np.concatenate([x, u]))[:n]


def flown(loop: Loop, timing: Timing, x0: Matrix, periods: int) -> list[Matrix]:
    """States at multiples of the common period: samples, messages and commands as a list of events in time.

    Before zero nothing was ever sent: u = 0 until the first command that finds a sample.
    """
    _, B, K = loop
    end_s = periods * timing.common_period_s
    events: list[tuple[float, int, str]] = []
    for i in range(periods * timing.samples + 1):
        taken_s = timing.phase_s + i * timing.sampling_s
        events += [(taken_s, i, "0 sample"), (taken_s + timing.up_s, i, "1 arrive")]
    for j in range(periods * timing.commands + 1):
        events += [(j * timing.control_s, j, "2 compute"), (j * timing.control_s + timing.down_s, j, "3 act")]
    events += [(k * timing.common_period_s, k, "4 look") for k in range(periods + 1)]
    now_s, x, u = 0.0, x0, np.zeros(B.shape[1])
    sent: dict[int, Matrix] = {}
    commands: dict[int, Matrix] = {}
    newest = np.zeros(B.shape[1])
    seen: list[Matrix] = []
    for instant_s, kind, number in sorted((round(t, 9), kind, number) for t, number, kind in events):
        if instant_s > end_s + 1e-9:
            break
        x, now_s = advanced(loop, x, u, instant_s - now_s), instant_s
        if kind == "0 sample":
            sent[number] = K @ x
        elif kind == "1 arrive":
            newest = sent[number]
        elif kind == "2 compute":
            commands[number] = newest
        elif kind == "3 act":
            u = commands[number]
        else:
            seen.append(x)
    return seen


@pytest.mark.parametrize("loop", [FOLLOWER, TWO_INPUTS], ids=["follower", "two inputs"])
@pytest.mark.parametrize(
    "timing",
    [
        Timing(0.2, 1, 1),
        Timing(0.2, 5, 2),
        Timing(0.2, 2, 5),
        Timing(0.2, 3, 4, phase_s=0.011),
        Timing(0.2, 5, 2, phase_s=0.013, up_s=0.031, down_s=0.047),
        Timing(0.2, 2, 5, phase_s=0.03, up_s=0.25, down_s=0.33),
        Timing(0.2, 1, 3, phase_s=0.17, up_s=0.2, down_s=0.0),
        Timing(0.2, 4, 4, phase_s=0.0, up_s=0.05, down_s=0.1),
    ],
    ids=str,
)
def test_map_predicts_what_is_flown(loop: Loop, timing: Timing) -> None:
    Phi = multirate_map(*loop, timing)
    x0 = np.array([1.0, -0.5, 0.3])[: len(loop[0])]
    state = np.concatenate([x0, np.zeros(len(Phi) - len(x0))])
    for sample in flown(loop, timing, x0, periods=8):
        # instants of the simulation are rounded to a nanosecond
        assert state[: len(x0)] == pytest.approx(sample, abs=1e-7)
        state = Phi @ state


@settings(deadline=None, max_examples=60)
@given(
    samples=st.integers(1, 5),
    commands=st.integers(1, 5),
    phase=st.floats(0.0, 0.99),
    up_ms=st.integers(0, 400),
    down_ms=st.integers(0, 400),
)
def test_command_uses_the_newest_sample_that_has_arrived(
    samples: int, commands: int, phase: float, up_ms: int, down_ms: int
) -> None:
    timing = Timing(0.2, samples, commands, phase * 0.2 / samples, up_ms / 1000.0, down_ms / 1000.0)
    for command in range(-3, 4):
        at_s, used = command * timing.control_s, timing.sample_used(command)
        # instants within rounding of each other count as one
        assert timing.phase_s + used * timing.sampling_s + timing.up_s <= at_s + 1e-9
        assert timing.phase_s + (used + 1) * timing.sampling_s + timing.up_s > at_s - 1e-9


@pytest.mark.parametrize("delay_s", [0.0, 0.03, 0.1, 0.23, 0.3])
@pytest.mark.parametrize("times", [1, 2, 5])
def test_equal_rates_are_the_sampled_loop(delay_s: float, times: int) -> None:
    timing = Timing(0.1 * times, times, times, down_s=delay_s)
    alone = spectral_radius(*TWO_INPUTS, period_s=0.1, delay_s=delay_s)
    # eigenvalues of maps of a few states
    assert multirate_spectral_radius(*TWO_INPUTS, timing) == pytest.approx(alone**times, rel=1e-12)


@pytest.mark.parametrize("period_s", [0.02, 0.1, 0.3])
def test_margin_at_equal_rates_is_the_sampled_margin(period_s: float) -> None:
    margin_s = multirate_delay_margin(*FOLLOWER, Timing(period_s, 1, 1), up_share=0.0)
    # bisection to rounding of a radius known to 1e-13 that moves by some 1 / s
    assert margin_s == pytest.approx(sampled_delay_margin(*FOLLOWER, period_s=period_s), rel=1e-10)


@pytest.mark.parametrize("up_share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("samples", "commands"), [(5, 2), (2, 5), (3, 4)])
def test_radius_reaches_one_at_the_margin_and_not_before(samples: int, commands: int, up_share: float) -> None:
    timing = Timing(0.1, samples, commands, phase_s=0.003)
    margin_s = multirate_delay_margin(*FOLLOWER, timing, up_share=up_share)
    assert 0.5 < margin_s < 0.72

    def radius(added_s: float) -> float:
        late = Timing(0.1, samples, commands, 0.003, up_share * added_s, (1.0 - up_share) * added_s)
        return multirate_spectral_radius(*FOLLOWER, late)

    assert all(radius(float(added_s)) < 1.0 for added_s in np.linspace(0.0, margin_s * (1.0 - 1e-6), 150))
    assert radius(margin_s * (1.0 + 1e-6)) >= 1.0


def test_faster_rates_approach_the_continuous_margin() -> None:
    # atan(omega) / omega at omega^2 = (1 + sqrt 5) / 2; waiting and hold cost at most one period of each rate
    continuous_s = 0.711118648715793
    for common_s in (0.1, 0.05):
        margin_s = multirate_delay_margin(*FOLLOWER, Timing(common_s, 5, 2))
        assert continuous_s - common_s / 5 - common_s / 2 < margin_s < continuous_s


def test_slower_telemetry_costs_margin() -> None:
    margins_s = [multirate_delay_margin(*FOLLOWER, Timing(0.6, samples, 6), up_share=0.0) for samples in (6, 3, 2, 1)]
    assert all(faster > slower for faster, slower in pairwise(margins_s))


def test_unstable_loop_has_no_margin_and_a_weak_one_no_limit() -> None:
    assert multirate_delay_margin([[1.0]], [[1.0]], [[-0.5]], Timing(0.1, 2, 1)) == 0.0
    assert multirate_delay_margin([[-1.0]], [[1.0]], [[-0.5]], Timing(0.1, 2, 1)) == inf


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"common_period_s": 0.0, "samples": 1, "commands": 1}, "common_period_s is 0.0"),
        ({"common_period_s": 0.1, "samples": 0, "commands": 1}, "samples is 0"),
        ({"common_period_s": 0.1, "samples": 1, "commands": -1}, "commands is -1"),
        ({"common_period_s": 0.1, "samples": 2, "commands": 1, "phase_s": 0.05}, "phase_s is 0.05"),
        ({"common_period_s": 0.1, "samples": 1, "commands": 1, "up_s": -1e-9}, "up_s is -1e-09"),
        ({"common_period_s": 0.1, "samples": 1, "commands": 1, "down_s": float("inf")}, "down_s is inf"),
    ],
)
def test_wrong_timing_is_named(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(BadModelError, match=message):
        Timing(**arguments)  # pyright: ignore[reportArgumentType]


def test_share_of_the_way_up_is_a_share() -> None:
    with pytest.raises(BadModelError, match=r"up_share is 1\.5"):
        multirate_delay_margin(*FOLLOWER, Timing(0.1, 1, 1), up_share=1.5)
