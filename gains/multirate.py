"""Telemetry at one rate, control at another: the sampled and held loop over the common period of both.

Within a common period T the vehicle samples its state p times, at phase + i T / p, and the station computes a command
q times, at j T / q. A sample reaches the station `up_s` later; each command uses the newest sample that has arrived,
u = K x(sample), acts `down_s` later and is held until the next one acts. Between events the plant x' = A x + B u is
integrated exactly, so one common period is a linear map of the state and of the samples still in use; the loop is
stable exactly when its spectral radius is below one. With p = q, no phase and no uplink delay this is `gains.sampled`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil, floor, inf, isfinite, lcm

import numpy as np
from numpy.typing import ArrayLike

from gains.delay import delay_margin
from gains.errors import BadModelError
from gains.sampled import checked_loop
from gains.sampled_loop import HeldPlant, held_blocks
from gains.structure import FloatArray

# instants closer than this (in common periods) are one: sums of periods and delays are known to rounding
_SAME_INSTANT = 1e-11
# delays looked at in the time of the shorter of the two periods
_LOOKS = 16
# the margin is searched up to this many continuous margins, and common periods more
_SEARCHED_MARGINS, _SEARCHED_PERIODS = 3.0, 10.0
# halvings of a bracket: a sixteenth of a period down to rounding
_HALVINGS = 48
# a local maximum of the radius is refined when its sample is above this
_NEAR_ONE = 0.99
_GOLDEN = (3.0 - 5.0**0.5) / 2.0


@dataclass(frozen=True)
class Timing:
    """When samples are taken, commands computed, and how long both travel.

    Attributes
    ----------
    common_period_s
        T (s); rates of 50 and 20 Hz have 0.1 s.
    samples, commands
        p and q: samples and commands in a common period.
    phase_s
        How long (s) after a command's instant the first sample is taken, 0 <= phase < T / p.
    up_s, down_s
        Delay (s) of a sample on its way to the station and of a command on its way to the vehicle.

    Raises
    ------
    BadModelError
        A number out of its range; the message names it.

    Examples
    --------
    Five samples and two commands in 0.1 s: 50 Hz and 20 Hz. The command at 0.05 s uses the sample of 0.04 s.

    >>> from gains.multirate import Timing
    >>> timing = Timing(0.1, samples=5, commands=2)
    >>> timing.sampling_s, timing.control_s, timing.sample_used(1)
    (0.02, 0.05, 2)
    """

    common_period_s: float
    samples: int
    commands: int
    phase_s: float = 0.0
    up_s: float = 0.0
    down_s: float = 0.0

    def __post_init__(self) -> None:
        if not (isfinite(self.common_period_s) and self.common_period_s > 0.0):
            raise BadModelError(f"common_period_s is {self.common_period_s}; a positive number of seconds is wanted")
        for name in ("samples", "commands"):
            if getattr(self, name) < 1:
                raise BadModelError(f"{name} is {getattr(self, name)}; 1 or more in a common period are wanted")
        for name in ("up_s", "down_s"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise BadModelError(f"{name} is {getattr(self, name)}; a number of seconds >= 0 is wanted")
        if not 0.0 <= self.phase_s < self.common_period_s / self.samples:
            raise BadModelError(
                f"phase_s is {self.phase_s}; 0 to below the sampling period of "
                f"{self.common_period_s / self.samples} s is wanted"
            )

    @property
    def sampling_s(self) -> float:
        """From one sample to the next, s."""
        return self.common_period_s / self.samples

    @property
    def control_s(self) -> float:
        """From one command to the next, s."""
        return self.common_period_s / self.commands

    def sample_used(self, command: int) -> int:
        """Index of the newest sample that has arrived at the instant of a command; sample 0 is taken at the phase."""
        periods = (command * self.control_s - self.phase_s - self.up_s) / self.sampling_s
        return floor(periods + _SAME_INSTANT * self.samples)

    def commands_acting(self) -> list[tuple[float, int]]:
        """Instants in [0, T) from which a command acts, with its index; the first one acts at 0 already."""
        first = floor(-self.down_s / self.control_s + _SAME_INSTANT * self.commands)
        acting = [(0.0, first)]
        for command in range(first + 1, first + self.commands + 1):
            instant_s = command * self.control_s + self.down_s
            if instant_s < self.common_period_s * (1.0 - _SAME_INSTANT):
                acting.append((instant_s, command))
        return acting


def multirate_spectral_radius(A: ArrayLike, B: ArrayLike, K: ArrayLike, timing: Timing) -> float:
    """Factor by which the slowest motion shrinks (< 1) or grows (> 1) in one common period.

    Parameters
    ----------
    A, B, K
        Real matrices (n, n), (n, p), (p, n); the feedback is u = +K x.

    Raises
    ------
    BadModelError
        Naming the argument, what was read and what was wanted.

    Examples
    --------
    x' = u, u = -x with one sample and two commands in 0.5 s: both commands use the one sample, x_{k+1} = (1 - T) x_k.

    >>> from gains.multirate import Timing, multirate_spectral_radius
    >>> round(multirate_spectral_radius([[0]], [[1]], [[-1]], Timing(0.5, samples=1, commands=2)), 6)
    0.5
    """
    return max(_radius(plant, timing) for plant in _blocks(A, B, K, timing))


def multirate_map(A: ArrayLike, B: ArrayLike, K: ArrayLike, timing: Timing) -> FloatArray:
    """The matrix that takes (x, K x(sample -1), K x(sample -2), ...) one common period on.

    Arguments and exceptions as of `multirate_spectral_radius`.

    Examples
    --------
    x' = u, u = -x with one sample and two commands in 0.5 s, the sample used 0.25 s after it was taken:

    >>> from gains.multirate import Timing, multirate_map
    >>> multirate_map([[0]], [[1]], [[-1]], Timing(0.5, samples=1, commands=2, up_s=0.25)).round(6).tolist()
    [[0.75, 0.25], [-1.0, 0.0]]
    """
    return _lifted(HeldPlant(*checked_loop(A, B, K), timing.common_period_s), timing)


def multirate_delay_margin(A: ArrayLike, B: ArrayLike, K: ArrayLike, timing: Timing, *, up_share: float = 0.5) -> float:
    """The least delay (s) up and down together, added to that of `timing`, at which the loop loses stability.

    `up_share` of it is on the way up, the rest on the way down. The delay up matters only through which sample a
    command finds, so the spectral radius jumps with it; between jumps it is continuous. Every jump is looked at from
    both sides, the stretches between at a sixteenth of a period, peaks refined: a search, not a proof. 0 if the loop is
    unstable as it is, `inf` if no limit is found within three times the margin of the continuous loop and ten common
    periods. Arguments as of `multirate_spectral_radius`.

    Raises
    ------
    BadModelError
        Naming the argument, what was read and what was wanted.

    Examples
    --------
    x' = u, u = -x at one rate, all delay on the way down: the margin of `gains.sampled`, 1 s with a period of 1 s.

    >>> from gains.multirate import Timing, multirate_delay_margin
    >>> round(multirate_delay_margin([[0]], [[1]], [[-1]], Timing(1.0, samples=1, commands=1), up_share=0.0), 6)
    1.0
    """
    if not 0.0 <= up_share <= 1.0:
        raise BadModelError(f"up_share is {up_share}; 0 (all on the way down) to 1 is wanted")
    plants = _blocks(A, B, K, timing)
    plant, entry, feedback = checked_loop(A, B, K)
    continuous_s = delay_margin(plant, entry @ feedback)
    known_s = continuous_s if isfinite(continuous_s) else 0.0
    last_s = _SEARCHED_MARGINS * known_s + _SEARCHED_PERIODS * timing.common_period_s

    def radius(added_s: float) -> float:
        late = replace(timing, up_s=timing.up_s + up_share * added_s, down_s=timing.down_s + (1.0 - up_share) * added_s)
        return max(_radius(block, late) for block in plants)

    if radius(0.0) >= 1.0:
        return 0.0
    for begin_s, end_s in pairwise(_jumps(timing, up_share, last_s)):
        inset_s = 10.0 * _SAME_INSTANT * timing.common_period_s
        points = ceil((end_s - begin_s) / min(timing.sampling_s, timing.control_s) * _LOOKS) + 2
        looks = np.linspace(begin_s + inset_s, end_s - inset_s, points).tolist()
        found_s = _first_unstable(radius, looks)
        if found_s < inf:
            # unstable just after a jump: the jump is the limit
            return begin_s if found_s == looks[0] else found_s
    return inf


def _first_unstable(radius: Callable[[float], float], looks: list[float]) -> float:
    """The least delay of a stretch at which the radius reaches one, `inf` if it does nowhere."""
    radii: list[float] = []
    for i, look in enumerate(looks):
        radii.append(radius(look))
        if radii[i] >= 1.0:
            return _bisected(radius, looks[i - 1], look) if i > 0 else look
        # a peak between two looks
        if i > 1 and radii[i - 1] > _NEAR_ONE and radii[i - 2] < radii[i - 1] > radii[i]:
            peak_s = _peak(radius, looks[i - 2], look)
            if radius(peak_s) >= 1.0:
                return _bisected(radius, looks[i - 2], peak_s)
    return inf


def _blocks(A: ArrayLike, B: ArrayLike, K: ArrayLike, timing: Timing) -> list[HeldPlant]:
    return held_blocks(*checked_loop(A, B, K), period_s=timing.common_period_s)


def _radius(plant: HeldPlant, timing: Timing) -> float:
    return float(np.abs(np.linalg.eigvals(_lifted(plant, timing))).max())


def _lifted(plant: HeldPlant, timing: Timing) -> FloatArray:
    """One common period, event by event; x and every K x(sample) as linear maps of the state at its beginning."""
    n, inputs = plant.B.shape
    acting = timing.commands_acting()
    used = {command: timing.sample_used(command) for _, command in acting}
    kept = max(0, -min(used.values()))
    size = n + kept * inputs
    start = np.eye(size)
    x = start[:n]
    samples = {-age: start[n + (age - 1) * inputs : n + age * inputs] for age in range(1, kept + 1)}
    sampled = [(timing.phase_s + i * timing.sampling_s, i) for i in range(timing.samples)]
    instants = _merged([instant for instant, _ in (*acting, *sampled)], timing.common_period_s)
    states, holds = plant.transition(np.diff([*instants, timing.common_period_s]))
    close_s = _SAME_INSTANT * timing.common_period_s
    for instant, Phi, hold in zip(instants, states, holds, strict=True):
        samples |= {i: plant.K @ x for taken, i in sampled if abs(taken - instant) <= close_s}
        command = max(command for begin, command in acting if begin <= instant + close_s)
        x = Phi @ x + hold @ samples[used[command]]
    history = [samples[timing.samples - age] for age in range(1, kept + 1)]
    return np.vstack([x, *history])


def _merged(instants: list[float], period_s: float) -> list[float]:
    """Ascending instants, those within rounding of each other once."""
    merged: list[float] = []
    for instant in sorted(instants):
        if not merged or instant - merged[-1] > _SAME_INSTANT * period_s:
            merged.append(instant)
    return merged


def _jumps(timing: Timing, up_share: float, last_s: float) -> list[float]:
    """Added delays (s), ascending from 0 to `last_s`, at which a command begins to find an older sample."""
    if up_share == 0.0:
        return [0.0, last_s]
    # instants of commands and of samples differ by the phase and multiples of this
    step_s = timing.common_period_s / lcm(timing.samples, timing.commands)
    offset_s = timing.phase_s + timing.up_s
    first, last = ceil(offset_s / step_s), floor((offset_s + up_share * last_s) / step_s)
    jumps = [(k * step_s - offset_s) / up_share for k in range(first, last + 1)]
    close_s = 100.0 * _SAME_INSTANT * timing.common_period_s
    return [0.0, *(jump for jump in jumps if close_s < jump < last_s - close_s), last_s]


def _bisected(radius: Callable[[float], float], stable_s: float, unstable_s: float) -> float:
    for _ in range(_HALVINGS):
        middle_s = (stable_s + unstable_s) / 2.0
        stable_s, unstable_s = (stable_s, middle_s) if radius(middle_s) >= 1.0 else (middle_s, unstable_s)
    return stable_s


def _peak(radius: Callable[[float], float], begin_s: float, end_s: float) -> float:
    """Place of the local maximum within a bracket, by golden section."""
    for _ in range(30):
        third, two_thirds = begin_s + _GOLDEN * (end_s - begin_s), end_s - _GOLDEN * (end_s - begin_s)
        begin_s, end_s = (begin_s, two_thirds) if radius(third) > radius(two_thirds) else (third, end_s)
    return (begin_s + end_s) / 2.0
