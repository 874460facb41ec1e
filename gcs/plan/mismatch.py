"""How far the loop delay may be from the assumed one, for each set of the gain schedule.

Without prediction the assumed delay is 0, and the loop delay may exceed it by the delay margin. With prediction the
loop delay may be anywhere in the mismatch window (`gains.sampled.prediction`).
"""

from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from math import inf
from typing import NamedTuple

import numpy as np

from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from gains.performance.response import Response, formation_loop
from gains.sampled.multirate import Timing
from gains.sampled.onboard import OnboardTiming, streamed_loop
from gains.sampled.prediction import mismatch_window, mismatch_window_continuous
from gains.varying.predicted import PredictedSpread
from scenarios.keys.part import PREDICTION_MAX_S
from scenarios.schema import Scenario

Window = tuple[float, float]
"""The range of loop delays (s) in which a loop is stable: shortest and longest."""
TABULATED_S = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.9, 1.3, 2.0, 3.0, 5.0, 7.0, PREDICTION_MAX_S)
"""Assumed delays (s) at which windows are tabulated if the station assumes the measured delay."""
_MOST_ON_THE_WAY = 2000
"""Maximum number of commands in transit for which the sampled window is computed."""


def used_s(shorter_s: float, longer_s: float, mismatch_s: float) -> float:
    """How much of `longer_s` a mismatch (loop delay minus assumed) uses up; one of -`shorter_s` uses all of it.

    If the loop delay is shorter than assumed: infinite if no shorter one is tolerated, zero if every one is.

    >>> used_s(0.1, 0.2, 0.05), used_s(0.1, 0.2, -0.05), used_s(inf, 0.2, -0.05)
    (0.05, 0.1, 0.0)
    """
    if not mismatch_s < 0.0:  # or it is unknown
        return mismatch_s
    if shorter_s == inf:
        return 0.0
    return -mismatch_s * longer_s / shorter_s if shorter_s > 0.0 else inf


class Tolerated(NamedTuple):
    """How much shorter and longer (s) than assumed the loop delay may be, for each set of the gain schedule.

    `shorter_s` is infinite where no delay is too short.
    """

    shorter_s: tuple[float, ...]
    longer_s: tuple[float, ...]

    def used_s(self, gain_set: int, mismatch_s: float) -> float:
        """See `used_s`."""
        return used_s(self.shorter_s[gain_set], self.longer_s[gain_set], mismatch_s)


def tabulated(windows: Sequence[Sequence[Window]]) -> Callable[[float], Tolerated]:
    """The tolerance at any assumed delay, interpolated between tabulated windows; the delay is rounded to 1 ms.

    `windows` holds, for each gain set, the window at each assumed delay in `TABULATED_S`. Interpolates the
    reciprocals of the distances, which are nearly linear: about k1 + k3 tau^. If only one of two neighbouring windows
    has a lower end, its distance is used.
    """
    with np.errstate(divide="ignore"):
        reciprocal = 1.0 / np.array(
            [[distances(at, s) for at, s in zip(own, TABULATED_S, strict=True)] for own in windows]
        )

    @cache
    def tolerated(assumed_ms: int) -> Tolerated:
        place = float(np.interp(1e-3 * assumed_ms, TABULATED_S, np.arange(len(TABULATED_S))))
        before, after = reciprocal[:, int(place)], reciprocal[:, -(-int(1e9 * place) // 10**9)]
        share = place - int(place)
        mixed = np.where((before == 0.0) | (after == 0.0), np.maximum(before, after), 0.0)
        # a reciprocal is infinite where nothing is tolerated; times a share of 0 it would be NaN
        between = before if share == 0.0 else (1.0 - share) * before + share * after
        mixed = np.where(mixed > 0.0, mixed, between)
        with np.errstate(divide="ignore"):
            shorter_s, longer_s = (tuple(side) for side in (1.0 / mixed).T.tolist())
        return Tolerated(shorter_s, longer_s)

    return lambda assumed_s: tolerated(round(1e3 * assumed_s))


def distances(window: Window, assumed_s: float) -> tuple[float, float]:
    """How much shorter and longer (s) than assumed a loop delay in this window may be."""
    least_s, most_s = window
    return assumed_s - least_s if least_s > 0.0 else inf, most_s - assumed_s


class Predicted(NamedTuple):
    """A formation whose station predicts, as a key for cached results."""

    model: FormationModel
    gain: bytes
    """K of u = K e."""
    timing: Timing
    responses: tuple[Response, ...] | None = None
    """Responses of the vehicles in the model's order; None if they respond at once."""
    onboard: OnboardTiming | None = None
    """The timing of the vehicles' own loops, if they have one."""

    @property
    def K(self) -> FloatArray:  # noqa: N802 - the letter of `gains`
        return np.frombuffer(self.gain).reshape(self.model.inputs, self.model.states)

    def loop(self) -> tuple[tuple[FloatArray, FloatArray, FloatArray], list[bool] | None]:
        """A, B and K, and which states are measured: the errors, but not the states of the responses."""
        model, K = self.model, self.K
        if self.onboard is not None:
            return streamed_loop(model, K, self.onboard), None
        if self.responses is None:
            return (model.A, model.B, K), None
        loop = formation_loop(model, K, self.responses)
        return loop, [k < model.states for k in range(len(loop[0]))]


@lru_cache(maxsize=1024)
def window(flown: Predicted, assumed_s: float) -> Window:
    """The mismatch window of a sampled formation whose station predicts over `assumed_s`.

    The map of one period has a state for each command in transit. If these are too many, the window is that of the
    continuous model, narrowed at either end by a common period of both rates, which exceeds the difference between
    the models. Cached: all flights of a campaign use the same windows.
    """
    if assumed_s > _MOST_ON_THE_WAY * flown.timing.faster_s:
        least_s, most_s = continuous_window(flown, assumed_s)
        return min(assumed_s, least_s + flown.timing.common_s), max(assumed_s, most_s - flown.timing.common_s)
    loop, measured = flown.loop()
    return mismatch_window(*loop, flown.timing, assumed_s=assumed_s, measured=measured)


def continuous_window(flown: Predicted, assumed_s: float) -> Window:
    """The mismatch window of the continuous model, without any hold, like the continuous delay margin."""
    loop, measured = flown.loop()
    return mismatch_window_continuous(*loop, assumed_s=assumed_s, measured=measured)


def proved_jump_s(flown: Predicted, assumed_s: float) -> float | None:
    """How early or late (s) each set-point may act while the formation is proved stable, at a constant telemetry age.

    None for loops on board and for shared loops, to which `PredictedSpread` does not apply.
    """
    loop, measured = flown.loop()
    if flown.onboard is not None or any(len(each) > 1 for each in flown.model.coupled_vehicles(flown.K)):
        return None
    return PredictedSpread(*loop, flown.timing, assumed_s, measured).bound_s(mean_s=assumed_s)


def assumption(scenario: Scenario) -> str:
    """What the prediction assumes about the set-points sent, as one line; empty without prediction."""
    as_sent = "every set-point acts as it was sent"
    if scenario.control.prediction == "off":
        return ""
    if scenario.target_hz > 0.0:
        return f"where vehicles do not report their active targets, {as_sent}"
    why = "rates.target_hz is 0" if scenario.rates.target_hz == 0.0 else "on board they do not show what acted"
    return f"{as_sent}: active targets are not requested, as {why}"
