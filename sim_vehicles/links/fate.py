"""What happens to one datagram on a link: a pure function of the link, the time and the random draws.

A link's schema is converted once into a frozen `LinkBehaviour`, with all times in ns. Each link has two random streams:
one decides loss, duplication and corruption, the other the jitter. Every datagram takes the same number of draws from
both, used or not. So more loss leaves the delays unchanged, and one link's traffic does not shift the draws of another.
"""

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from scenarios.keys import link as link_keys
from scenarios.schema import NS_PER_S
from sim_vehicles.links.truth import CORRUPTED, LOST, OUTAGE, PASSED

MOST_FLIPS = 4
_BLOCK = 128
"""Datagrams whose draws are made together: numpy takes as long for one as for a hundred."""


class Draws(NamedTuple):
    """All that is random about one datagram: uniform in [0, 1), except the jitter."""

    burst: float
    loss: float
    duplicate: float
    corrupt: float
    flips: tuple[float, ...]
    """Where bits are flipped, as fractions of the datagram's length; `corrupt` also says how many are used."""
    jitter_ns: int
    duplicate_jitter_ns: int


class Fate(NamedTuple):
    """What happens to a datagram."""

    fate: int
    bad: bool
    """Whether the next datagram finds the link in its bad state."""
    delay_ns: int
    duplicate_delay_ns: int
    """-1 if there is no second copy."""
    flips: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class LinkBehaviour:
    """A link's schema with its times as integers of ns."""

    points_ns: tuple[tuple[int, int], ...]
    """(link time, delay), at least one."""
    least_delay_ns: int
    """A lower bound of every datagram's delay."""
    outages_ns: tuple[tuple[int, int], ...]
    reordering: bool
    to_bad: float
    to_good: float
    loss_good: float
    loss_bad: float
    duplicate: float
    corrupt: float

    @property
    def timed(self) -> bool:
        """Whether the behaviour changes with time."""
        return len(self.points_ns) > 1 or bool(self.outages_ns)


def behaviour_of(link: link_keys.Link) -> LinkBehaviour:
    points = [(point.at_s, point.delay_s) for point in link.delay_points] or [(0.0, link.delay_s)]
    points_ns = tuple((_ns(time_s), _ns(delay_s)) for time_s, delay_s in points)
    bursts, least_jitter_ns = link.loss_bursts, 0 if link.jitter is None else _ns(link.jitter.least_s)
    return LinkBehaviour(
        points_ns=points_ns,
        least_delay_ns=max(0, min(delay_ns for _, delay_ns in points_ns) + least_jitter_ns),
        outages_ns=tuple((_ns(outage.from_s), _ns(outage.until_s)) for outage in link.outages),
        reordering=link.reordering,
        to_bad=bursts.to_bad_probability if bursts else 0.0,
        to_good=bursts.to_good_probability if bursts else 1.0,
        loss_good=bursts.loss_good_probability if bursts else link.loss_probability,
        loss_bad=bursts.loss_bad_probability if bursts else 0.0,
        duplicate=link.duplicate_probability,
        corrupt=link.corrupt_probability,
    )


def constant(link: link_keys.Link) -> bool:
    """Whether the link only delays, by its constant delay_s."""
    plain = link_keys.Link(delay_s=link.delay_s, reordering=link.reordering, channel=link.channel)
    return link == plain and link.channel is None


def outcome(link: LinkBehaviour, *, bad: bool, time_ns: int, draws: Draws) -> Fate:
    """The fate of a datagram that enters at link time `time_ns`, with the link's state `bad` since the last datagram.

    A channel or a full link may still drop it.
    """
    bad = draws.burst >= link.to_good if bad else draws.burst < link.to_bad
    fate = PASSED
    for from_ns, until_ns in link.outages_ns:
        if from_ns <= time_ns < until_ns:
            fate |= OUTAGE
    if draws.loss < (link.loss_bad if bad else link.loss_good):
        fate |= LOST
    flips: tuple[float, ...] = ()
    if draws.corrupt < link.corrupt:
        fate |= CORRUPTED
        # Given that it is below its bound, the draw is uniform again: it also picks the number of flips.
        flips = draws.flips[: 1 + int(MOST_FLIPS * draws.corrupt / link.corrupt)]
    delay_ns = delay_at(link, time_ns)
    twice = draws.duplicate < link.duplicate
    duplicate_ns = max(0, delay_ns + draws.duplicate_jitter_ns) if twice else -1
    return Fate(fate, bad, max(0, delay_ns + draws.jitter_ns), duplicate_ns, flips)


def delay_at(link: LinkBehaviour, time_ns: int) -> int:
    """The delay without jitter at a link time: linear between points; at a step, the delay after it."""
    points = link.points_ns
    if len(points) == 1:
        return points[0][1]
    after = bisect_right(points, time_ns, key=lambda point: point[0])
    if after in (0, len(points)):
        return points[after - (after > 0)][1]
    (begin_ns, before_ns), (end_ns, then_ns) = points[after - 1], points[after]
    return before_ns + (then_ns - before_ns) * (time_ns - begin_ns) // (end_ns - begin_ns)


def flipped(data: bytes, flips: tuple[float, ...]) -> bytes:
    """The datagram with bits flipped at these fractions of its length; a place named twice flips once."""
    changed = bytearray(data)
    for place in {int(part * len(data) * 8) for part in flips} if data else ():
        changed[place // 8] ^= 1 << place % 8
    return bytes(changed)


class _Delays(Protocol):
    """Draws the jitter of a number of datagrams and of their duplicates, in s."""

    def __call__(self, count: int) -> list[tuple[float, float]]: ...


class Stream:
    """The draws of one link, datagram by datagram."""

    def __init__(self, link: link_keys.Link, seeds: np.random.SeedSequence) -> None:
        fates, delays = seeds.spawn(2)
        self._fates = np.random.default_rng(fates)
        self._delays = _delays_of(link.jitter, np.random.default_rng(delays))
        self._block: list[Draws] = []

    def next(self) -> Draws:
        if not self._block:
            uniform: list[list[float]] = self._fates.random((_BLOCK, 4 + MOST_FLIPS)).tolist()
            delays = self._delays(_BLOCK)
            self._block = [
                Draws(burst, loss, duplicate, corrupt, tuple(flips), _ns(first_s), _ns(second_s))
                for (burst, loss, duplicate, corrupt, *flips), (first_s, second_s) in zip(uniform, delays, strict=True)
            ]
            self._block.reverse()
        return self._block.pop()


def _delays_of(jitter: link_keys.Jitter | None, rng: np.random.Generator) -> _Delays:
    if jitter is None:
        return lambda count: [(0.0, 0.0)] * count
    if jitter.distribution == "trace":
        return _in_trace_order(jitter.trace_s or (0.0,), rng)
    return lambda count: [(first, second) for first, second in jitter.drawn_s((count, 2), rng).tolist()]


def _in_trace_order(trace_s: tuple[float, ...], rng: np.random.Generator) -> _Delays:
    """A trace in its own order, which keeps the correlation of neighbours; a duplicate takes the next delay."""
    at = int(rng.integers(len(trace_s)))

    def drawn(count: int) -> list[tuple[float, float]]:
        nonlocal at
        places = [(at + k) % len(trace_s) for k in range(count + 1)]
        at = places[-1]
        return [(trace_s[k], trace_s[then]) for k, then in pairwise(places)]

    return drawn


def _ns(time_s: float) -> int:
    return round(time_s * NS_PER_S)
