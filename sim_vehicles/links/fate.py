"""The fate of a datagram on a link, decided by the link's settings, the time and random draws.

Each link has two random streams: one decides loss, duplication and corruption, the other the jitter. Every datagram
takes the same number of draws from both, used or not. So more loss leaves the delays unchanged, and one link's traffic
does not shift the draws of another.
"""

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scenarios.kernel import Record, Records, kernel
from scenarios.keys import link as link_keys
from scenarios.schema import NS_PER_S

MOST_FLIPS = 4
BLOCK, BLOCKS = 256, 2
"""Draws are made for BLOCK datagrams at once, because numpy takes as long for one as for a hundred. BLOCKS such blocks
form a ring buffer: one is refilled while part of the other is left."""


DRAW = np.dtype(
    [
        ("burst", "f8"), ("loss", "f8"), ("duplicate", "f8"), ("corrupt", "f8"),
        ("jitter_ns", "i8"), ("duplicate_jitter_ns", "i8"),
        ("flips", "f8", (MOST_FLIPS,)),  # where bits are flipped; `corrupt` also says how many are used
    ]
)  # fmt: skip
"""The random draws of one datagram: uniform in [0, 1), except the jitter."""
Pairs = Sequence[tuple[int, int]]


def constant(link: link_keys.Link) -> bool:
    """Whether the link only delays, by its constant delay_s."""
    plain = link_keys.Link(delay_s=link.delay_s, reordering=link.reordering, channel=link.channel)
    return link == plain and link.channel is None


def in_outage(outages_ns: Pairs, time_ns: int) -> bool:
    """Whether a link time lies in an outage, in which everything that enters is lost, given (from, until) of each."""
    return any(from_ns <= time_ns < until_ns for from_ns, until_ns in outages_ns)


def delay_at(points: Pairs, time_ns: int) -> int:
    """Delay without jitter at a link time, in ns, given at least one point (link time, delay) in ns.

    It is linear between points; at a step, it is the delay after the step.
    """
    if len(points) == 1:
        return points[0][1]
    after = bisect_right(points, time_ns, key=lambda point: point[0])
    if after in (0, len(points)):
        return points[after - (after > 0)][1]
    (begin_ns, before_ns), (end_ns, then_ns) = points[after - 1], points[after]
    return before_ns + (then_ns - before_ns) * (time_ns - begin_ns) // (end_ns - begin_ns)


@kernel
def drawn_bad(link: Record, draw: Record) -> bool:
    """Whether a datagram finds a link in its bad state, given the state that the previous datagram found."""
    return draw.burst >= link.to_good if link.bad else draw.burst < link.to_bad


@kernel
def flips_of(probability: float, drawn: float) -> int:
    """Number of bits flipped in a corrupted datagram, counting one that is drawn twice as two.

    A draw below the probability, divided by it, is again uniform in [0, 1).
    """
    return min(MOST_FLIPS, 1 + int(MOST_FLIPS * drawn / probability))


@kernel
def flip(data: NDArray[np.uint8], size: int, flips: NDArray[np.float64], count: int) -> None:
    """Flip bits at fractions of a datagram's length; a bit drawn twice is flipped once."""
    for k in range(count if size else 0):
        place = int(flips[k] * size * 8)
        first = True
        for other in range(k):
            first = first and int(flips[other] * size * 8) != place
        if first:
            data[place // 8] ^= 1 << place % 8


class Stream:
    """The draws of one link, a block at a time. A link that never loses or changes datagrams needs only the jitter."""

    def __init__(self, link: link_keys.Link, seeds: np.random.SeedSequence) -> None:
        self._fates, self._delays = map(np.random.default_rng, seeds.spawn(2))
        self._jitter = link.jitter
        self._only_delays = constant(link.model_copy(update={"jitter": None}))
        self._trace_s, self._at = np.zeros(1), 0
        if link.jitter is not None and link.jitter.distribution == "trace":
            self._trace_s = np.array(link.jitter.trace_s or (0.0,))
            self._at = int(self._delays.integers(len(self._trace_s)))

    def fill(self, block: Records) -> None:
        """Fill a block of `DRAW` with the next draws."""
        if not self._only_delays:
            uniform = self._fates.random((BLOCK, 4 + MOST_FLIPS))
            for k, name in enumerate(("burst", "loss", "duplicate", "corrupt")):
                block[name] = uniform[:, k]
            block["flips"] = uniform[:, 4:]
        if self._jitter is not None:
            delays_ns = np.rint(self._delays_s(self._jitter) * NS_PER_S)
            block["jitter_ns"], block["duplicate_jitter_ns"] = delays_ns.T

    def _delays_s(self, jitter: link_keys.Jitter) -> NDArray[np.float64]:
        """The jitter of each datagram of a block and of its duplicate, (BLOCK, 2).

        Delays of a trace keep their order, which preserves their correlation; a duplicate takes the next delay.
        """
        if jitter.distribution != "trace":
            return jitter.drawn_s((BLOCK, 2), self._delays)
        delays_s = self._trace_s[(self._at + np.arange(BLOCK + 1)) % len(self._trace_s)]
        self._at += BLOCK
        return np.column_stack([delays_s[:-1], delays_s[1:]])
