"""The emulated radio links of a scenario, as the file describes them; `sim_vehicles.links` implements them.

`Jitter` holds everything about a distribution of jitter: its keys, its draws and its lower bound.
"""

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from scenarios.errors import InWords
from scenarios.keys.part import MOST, Fault, NotNegative, Part, Positive, Probability, SystemId

TRACE_DELAYS = 100_000
"""Largest number of delays in a trace."""


class Jitter(Part):
    """A random delay drawn for each datagram and added to the link's delay; their sum is at least 0.

    uniform      from -scale_s to +scale_s: mean 0, standard deviation scale_s / sqrt(3)
    normal       mean 0, standard deviation scale_s
    exponential  from 0 up: mean and standard deviation scale_s
    gamma        from 0 up: mean shape * scale_s, standard deviation sqrt(shape) * scale_s
    trace        measured delays in order, from a starting point drawn for each link, wrapping around
    """

    distribution: Literal["uniform", "normal", "exponential", "gamma", "trace"]
    """The distribution of the delay."""
    scale_s: Positive | None = None
    """Scale of the distribution; required by all but `trace`."""
    shape: Positive | None = None
    """Shape of the gamma distribution; required by `gamma` only."""
    trace_file: str | None = None
    """File of measured delays, relative to the scenario file: one delay in s per line, or CSV with a column `delay_s`.
    It is read once, with the scenario, which then holds the delays themselves in `trace_s`."""
    trace_s: tuple[NotNegative, ...] | None = None
    """The measured delays, in place of `trace_file`."""

    def drawn_s(self, size: int | tuple[int, int], rng: np.random.Generator) -> npt.NDArray[Any]:
        """Random delays (s) in an array of this size; a trace is repeated in its order, from a random start."""
        scale_s = self.scale_s or 0.0
        match self.distribution:
            case "uniform":
                return rng.uniform(-scale_s, scale_s, size)
            case "normal":
                return rng.normal(0.0, scale_s, size)
            case "exponential":
                return rng.exponential(scale_s, size)
            case "gamma":
                return rng.gamma(self.shape or 1.0, scale_s, size)
            case "trace":
                trace = np.array(self.trace_s or (0.0,))
                return np.resize(np.roll(trace, -int(rng.integers(len(trace)))), size)

    @property
    def least_s(self) -> float:
        """A lower bound of the delays (s)."""
        match self.distribution:
            case "uniform":
                return -(self.scale_s or 0.0)
            case "normal":
                return -MOST  # no bound: no link delays by more
            case "exponential" | "gamma":
                return 0.0
            case "trace":
                return min(self.trace_s or (0.0,))

    def contradictions(self, key: str) -> Iterator[Fault]:
        """Contradictions between these keys; `key` is their place in the file."""
        which, traces = f"with distribution {self.distribution}", (self.trace_file, self.trace_s)
        needed = {"gamma": ("scale_s", "shape"), "trace": ()}.get(self.distribution, ("scale_s",))
        possible = ("trace_file", "trace_s") if self.distribution == "trace" else needed
        for name in ("scale_s", "shape", "trace_file", "trace_s"):
            value = getattr(self, name)
            if value is None and name in needed:
                yield f"{key}.{name}", None, f"a number, {which}"
            if value is not None and name not in possible:
                yield f"{key}.{name}", value, f"no such key {which}"
        if self.distribution == "trace" and traces.count(None) != 1:
            yield key, InWords("both" if all(traces) else "neither"), f"either trace_file or trace_s {which}"
        if self.trace_s is not None and not 1 <= len(self.trace_s) <= TRACE_DELAYS:
            yield f"{key}.trace_s", InWords(f"{len(self.trace_s)} delays"), f"1 to {TRACE_DELAYS}"


class LossBursts(Part):
    """Gilbert-Elliott loss: a link starts good and may change between good and bad with every datagram that enters.

    The link is bad for p / (p + r) of the datagrams; a burst lasts 1 / r datagrams on average.
    """

    to_bad_probability: Probability
    """p: probability that a good link is bad for the next datagram."""
    to_good_probability: Annotated[float, Field(gt=0, le=1)]
    """r: probability that a bad link is good for the next datagram."""
    loss_good_probability: Probability = 0.0
    """Probability that a good link loses a datagram."""
    loss_bad_probability: Probability = 1.0
    """Probability that a bad link loses a datagram."""


class DelayPoint(Part):
    """A link's delay without jitter at one time; linear between points. Two points at one time make a step."""

    at_s: NotNegative
    """Link time of the point."""
    delay_s: NotNegative
    """Delay at that time."""


class Outage(Part):
    """A time during which everything that enters the link is lost."""

    from_s: NotNegative
    """Link time at which the outage begins."""
    until_s: Positive
    """Link time at which it ends."""


class Link(Part):
    """One direction of a radio link. Times are link times, see `links.times_from`.

    A datagram meets, in this order: an outage or a full channel queue, which drops it; the channel, which takes time to
    send it; loss, or flipped bits; and the delay with its jitter, after which it arrives.
    """

    delay_s: NotNegative = 0.0
    """Constant one-way delay."""
    delay_points: tuple[DelayPoint, ...] = ()
    """A delay that changes over time, in place of `delay_s`. Each datagram gets the delay at the time it enters."""
    jitter: Jitter | None = None
    """Random delay on top of the constant one."""
    reordering: bool = False
    """Whether a datagram may overtake an earlier one. If not, it waits for the earlier one."""
    loss_probability: Probability = 0.0
    """Probability that a datagram is lost, independently of the others."""
    loss_bursts: LossBursts | None = None
    """Loss in bursts, in place of `loss_probability`."""
    duplicate_probability: Probability = 0.0
    """Probability that a datagram which arrives is duplicated. The copy has its own jitter."""
    corrupt_probability: Probability = 0.0
    """Probability that a datagram arrives with one to four of its bits flipped."""
    outages: tuple[Outage, ...] = ()
    """Times during which everything is lost."""
    channel: str | None = None
    """Name of the entry of `links.channels` that this link uses; without it the bandwidth is unlimited."""

    @property
    def delay_max_s(self) -> float:
        """The largest delay, without jitter."""
        return max((point.delay_s for point in self.delay_points), default=self.delay_s)


class VehicleLinks(Part):
    """The links of one vehicle, where they differ from those of the others."""

    system_id: SystemId
    """The vehicle."""
    up: Link | None = None
    """Its link to the station; replaces `links.up` as a whole."""
    down: Link | None = None
    """Its link from the station; replaces `links.down` as a whole."""


class Channel(Part):
    """A limited bandwidth: one datagram is sent at a time; the others wait in order of arrival.

    A datagram takes size * bits_per_byte / bandwidth_bit_s. One that finds the queue full is dropped; an idle channel
    takes a datagram of any size.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    """Name by which links refer to the channel."""
    bandwidth_bit_s: Annotated[float, Field(ge=1, le=1e12)]
    """Bits sent per second."""
    bits_per_byte: Annotated[int, Field(ge=8, le=16)] = 8
    """Bits on the air per byte of the datagram. A serial radio adds a start and a stop bit (8N1): 10."""
    queue_bytes: Annotated[int, Field(ge=0, le=10**9)] | None = None
    """Maximum number of bytes that wait, not counting the datagram being sent; unlimited if omitted."""
    queue_datagrams: Annotated[int, Field(ge=0, le=10_000)] | None = None
    """Maximum number of datagrams that wait, not counting the one being sent; unlimited if omitted."""
    shared: bool = True
    """True: one channel for all vehicles whose links name it. False: each vehicle has a channel of its own."""
    half_duplex: bool = False
    """True: up and down share the bandwidth and the queue. False: each direction has its own."""


class Links(Part):
    """Emulated links: up is vehicle to station, down is station to vehicle."""

    profile: str | None = None
    """Name of a link profile (`gcs scenarios --links`), or a file that `gcs monitor --save-links` wrote, relative to
    the scenario file; in place of `up`, `down` and `channels`. It is read once, with the scenario, which then holds the
    links themselves."""
    up: Link = Link()
    """From each vehicle to the station."""
    down: Link = Link()
    """From the station to each vehicle."""
    vehicles: tuple[VehicleLinks, ...] = ()
    """Vehicles whose links differ."""
    channels: tuple[Channel, ...] = ()
    """Channels of limited bandwidth that links may use."""
    times_from: Literal["flight", "start"] = "flight"
    """Zero of the link time, to which outages and delay points refer. `flight`: when the station's first set-point
    enters a link; before that, the first delay point applies and there is no outage. `start`: when the vehicles
    start."""
    one_port: bool = False
    """Whether the vehicles of each network share one UDP port, as behind a radio or a router, instead of having one
    each. In real time, frames that are due together then travel in one datagram of up to 1400 bytes. Delay, loss and
    all else still happen to each frame by itself."""
