"""The scenario: one typed, frozen object that says everything a flight depends on.

Units are part of each key's name. Positions and velocities are in the horizontal plane of one local NED frame,
as pairs (north, east). All vehicles fly at one altitude: the formation control is planar.

Numbers are bounded where the messages (single precision) and the clocks (nanoseconds) can still tell them apart.
"""

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

MOST = 1e6
Number = Annotated[float, Field(ge=-MOST, le=MOST)]
Position = tuple[Number, Number]
Speed = Annotated[float, Field(ge=-1e4, le=1e4)]
Velocity = tuple[Speed, Speed]
SystemId = Annotated[int, Field(ge=1, le=250)]
Positive = Annotated[float, Field(gt=0, le=MOST)]
NotNegative = Annotated[float, Field(ge=0, le=MOST)]
Factor = Annotated[float, Field(ge=1, le=1000)]
Headroom = Annotated[float, Field(ge=-1000, lt=1)]
Rate = Annotated[float, Field(ge=1, le=500)]
Probability = Annotated[float, Field(ge=0, le=1)]
Flavour = Literal["ardupilot", "px4"]
NS_PER_S = 1_000_000_000


class Part(BaseModel):
    """Base of every part of a scenario: unknown keys, wrong types, NaN and infinities are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Vehicle(Part):
    """One UAV: whom it follows, where it flies relative to that vehicle, and its state when the flight begins."""

    system_id: SystemId
    follows: SystemId | None = None
    """System id of the vehicle in front; the one vehicle without it is the leader."""
    offset_ne_m: Position | None = None
    """Wanted position relative to the vehicle in front (minus the spacing d of thesis eq. 2.10)."""
    hears: tuple[SystemId, ...] = ()
    """Vehicles besides the one in front whose errors its command may use; with a graph method only."""
    position_ne_m: Position
    velocity_ne_m_s: Velocity
    flavour: Flavour | None = None
    """Whose autopilot it is, if not that of the others; only with dynamics autopilot."""


class NominalVelocity(Part):
    """The formation's velocity v_d from a scenario time on, until the next entry."""

    from_s: NotNegative
    velocity_ne_m_s: Velocity


class Limits(Part):
    """Limits of every vehicle; one left out is off, but the least speed, without which the kinematics are singular."""

    speed_min_m_s: Positive = 1.0
    speed_max_m_s: Positive | None = None
    acceleration_max_m_s2: Positive | None = None
    turn_rate_max_rad_s: Positive | None = None


class Rates(Part):
    """How often things happen, in Hz."""

    control_hz: Rate = 50.0
    telemetry_hz: Rate = 50.0
    timesync_hz: Annotated[float, Field(ge=0.01, le=50)] = 10.0
    """Of each vehicle; at most control_hz, as each control tick logs one round trip."""


class FixedGains(Part):
    """Gains to be flown as they are, per axis: u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p."""

    K1: Number
    K2: Number
    K3: Number


class GainBlock(Part):
    """What one vehicle's errors add to another's command, or to its own: a block of the gain matrix K of u = K e."""

    vehicle: SystemId
    """Whose command."""
    of: SystemId
    """Whose errors."""
    gain: tuple[tuple[Number, ...], tuple[Number, ...]]
    """Rows for north and east; columns for the spacing error (north, east) and the velocity error (north, east). The
    leader has a velocity error only."""


class Control(Part):
    """How the gains are found and where the loop is closed.

    With neither requirement nor gains, a delay margin of 0.3 s is required. With a delay margin required, robustness is
    made as large as possible; without, the delay margin. What is required is met or the design says why it cannot be.
    """

    method: Literal["inclusion", "graph-dk", "graph-lqr"] = "inclusion"
    """inclusion: every vehicle uses its own errors and the velocity error of the one in front. The graph methods use
    all errors of these two, and of those it hears."""
    loop: Literal["ground", "onboard"] = "ground"
    """ground: the station closes every loop, and all feedback is late. onboard: every vehicle feeds back its own errors
    by itself, and the station streams what depends on those of others (thesis eq. 5.1). There string_peak_max is judged
    at every delay, and delay_margin_s limits the vehicles' own gains: to those that would take it in a ground loop."""
    delay_margin_s: Positive | None = None
    """Least delay margin of the sampled loop."""
    alpha: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Least robustness bound (thesis eq. 3.29)."""
    decay_rate_1_s: Positive | None = None
    """Least decay rate of the continuous loop without delay."""
    string_peak_max: Factor = 1.0
    """Most that spacing errors may grow from one vehicle to the next, whatever their frequency: with 1 not at all."""
    gains: FixedGains | None = None
    blocks: tuple[GainBlock, ...] = ()
    """In place of a design, the gain matrix block by block; blocks left out are zero."""


class Onboard(Part):
    """The loop on board of each vehicle, with control.loop onboard, and its sensor for the vehicle ahead."""

    rate_hz: Rate = 100.0
    """How often the vehicle computes its own part of the command; a whole multiple of sensor_hz."""
    sensor_hz: Rate = 50.0
    """How often the sensor sees the vehicle ahead; a whole multiple of rates.control_hz. In between the position is
    carried on with the relative velocity."""
    position_noise_m: NotNegative = 0.0
    """Standard deviation of the sensor's relative position, in each axis; normal, independent from look to look."""
    velocity_noise_m_s: NotNegative = 0.0
    """The same of its relative velocity."""


class Jitter(Part):
    """What is added to the delay of each datagram anew. Delay and jitter together are cut off at 0 from below.

    uniform      from -scale_s to +scale_s: mean 0, standard deviation scale_s / sqrt(3)
    normal       mean 0, standard deviation scale_s
    exponential  from 0 on: mean and standard deviation scale_s
    gamma        from 0 on: mean shape * scale_s, standard deviation sqrt(shape) * scale_s
    trace        measured delays, one datagram after the other from a place drawn for each link, then from the first
    """

    distribution: Literal["uniform", "normal", "exponential", "gamma", "trace"]
    scale_s: Positive | None = None
    shape: Positive | None = None
    trace_file: str | None = None
    """Relative to the scenario file: a delay in s on each line, or CSV with a column delay_s. Read with the scenario,
    which then holds the delays themselves in trace_s."""
    trace_s: tuple[NotNegative, ...] | None = None


class LossBursts(Part):
    """Gilbert-Elliott loss: a link is good, as at first, or bad; it may change with every datagram that enters.

    The part of all datagrams that find it bad is p / (p + r); a bad time lasts 1 / r datagrams in the mean.
    """

    to_bad_probability: Probability
    """p, of a good link to be bad for the next datagram."""
    to_good_probability: Annotated[float, Field(gt=0, le=1)]
    """r, of a bad link to be good for the next datagram."""
    loss_good_probability: Probability = 0.0
    loss_bad_probability: Probability = 1.0


class DelayPoint(Part):
    """The constant part of a link's delay at one time. Linear in between; two points at one time are a step."""

    at_s: NotNegative
    delay_s: NotNegative


class Outage(Part):
    """From `from_s` on, and before `until_s`, whatever enters the link is lost."""

    from_s: NotNegative
    until_s: Positive


class Link(Part):
    """One direction of a radio link. Times are link times, see Links.times_from.

    What happens to a datagram, in this order: an outage or a full queue of the channel drops it, the channel takes its
    time to send it, it is lost on the way or some of its bits are flipped, and it arrives after delay and jitter.
    """

    delay_s: NotNegative = 0.0
    delay_points: tuple[DelayPoint, ...] = ()
    """Instead of delay_s; a datagram's delay is that of the time at which it enters."""
    jitter: Jitter | None = None
    reordering: bool = False
    """Whether a datagram may overtake an earlier one. If not, it waits for it."""
    loss_probability: Probability = 0.0
    loss_bursts: LossBursts | None = None
    duplicate_probability: Probability = 0.0
    """Of what arrives. The second copy has a jitter of its own."""
    corrupt_probability: Probability = 0.0
    """Of a datagram to arrive with one to four of its bits flipped."""
    outages: tuple[Outage, ...] = ()
    channel: str | None = None
    """Name of one of Links.channels; without it the link has no limit of bandwidth."""


class VehicleLinks(Part):
    """The links of one vehicle, where they differ from those of the others."""

    system_id: SystemId
    up: Link | None = None
    down: Link | None = None


class Channel(Part):
    """A limited bandwidth: one datagram is sent at a time, the others wait in order of their coming.

    What finds the queue full is dropped; an idle channel takes a datagram of any size. A datagram takes
    size * bits_per_byte / bandwidth_bit_s. A serial radio has a start and a stop bit (8N1): 10 bits per byte.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    bandwidth_bit_s: Annotated[float, Field(ge=1, le=1e12)]
    bits_per_byte: Annotated[int, Field(ge=8, le=16)] = 8
    queue_bytes: Annotated[int, Field(ge=0, le=10**9)] | None = None
    """Most bytes that wait; what is being sent waits no more."""
    queue_datagrams: Annotated[int, Field(ge=0, le=10_000)] | None = None
    shared: bool = True
    """One for all vehicles whose links name it; otherwise each vehicle has one of its own."""
    half_duplex: bool = False
    """Up and down share the bandwidth and the queue; otherwise each direction has its own."""


class Links(Part):
    """Emulated links: up is vehicle to station, down is station to vehicle."""

    up: Link = Link()
    down: Link = Link()
    vehicles: tuple[VehicleLinks, ...] = ()
    channels: tuple[Channel, ...] = ()
    times_from: Literal["flight", "start"] = "flight"
    """When the time of outages and delay points is 0: when the station's first set-point enters a link (before that
    the delay is the first point's and there is no outage), or when the vehicles start."""

    def of(self, system_id: int) -> tuple[Link, Link]:
        """The (up, down) links of one vehicle."""
        for own in self.vehicles:
            if own.system_id == system_id:
                return own.up or self.up, own.down or self.down
        return self.up, self.down


class Clocks(Part):
    """Boot clocks of the vehicles: offset and drift are drawn from the seed within these bounds."""

    offset_max_s: Annotated[float, Field(ge=0, le=1e6)] = 100.0
    drift_max_ppm: Annotated[float, Field(ge=0, le=1e4)] = 20.0


class Safety(Part):
    """When a vehicle helps itself, when the flight is ended early, and what counts as settled."""

    setpoint_timeout_s: Positive = 1.0
    heartbeat_timeout_s: Positive = 3.0
    spacing_error_limit_m: Positive = 1000.0
    collision_distance_m: NotNegative = 5.0
    """Vehicles nearer than this to each other have collided."""
    settled_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """A follower has settled when its spacing error is below this part of its spacing."""


class Monitor(Part):
    """When the station acts on a shrinking headroom (1 - loop delay / margin), and how."""

    act: bool = True
    """Off: the modes are shown, and nothing is done."""
    caution_headroom: Headroom = 0.3
    critical_headroom: Headroom = 0.15
    hysteresis: NotNegative = 0.05
    window_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    """The loop delay judged is the one that nine tenths of the flight's ticks in this window stay below."""
    hold_s: NotNegative = 0.3
    """How long a condition holds before the slower side is taken,"""
    ease_s: NotNegative = 3.0
    """and before the faster one is taken back."""
    blend_s: Positive = 1.0
    """How long a change of gains takes."""
    time_scales: Annotated[tuple[Factor, ...], Field(min_length=1, max_length=8)] = (
        1.0,
        2.0,
        4.0,
    )
    """The gain schedule: the design slowed down by these factors, which multiplies its delay margin by them."""
    open_factor: Factor = 1.5
    """The formation's spacing is opened by this factor when the slowest gains have too little headroom,"""
    open_s: Positive = 10.0
    """over this time."""


class ClockJump(Part):
    """A vehicle's boot clock is set, as that of a simulator that could not keep up."""

    at_s: Positive
    """Time since the vehicles were started."""
    by_s: Number


class Autopilot(Part):
    """A simulated multicopter with dynamics `autopilot`: how it starts, and how it answers to set-points.

    It stands on the ground at its position until it is told to take off. The wanted acceleration is that of the
    set-point plus `velocity_gain_1_s` times what is missing from its velocity; the real one follows with a lag.
    """

    flavour: Flavour = "ardupilot"
    """Modes, numbers and rules of ArduCopter or of PX4."""
    lag_s: Positive = 0.15
    """Time constant from wanted to real acceleration."""
    velocity_gain_1_s: Positive = 2.0
    acceleration_max_m_s2: Positive = 5.0
    speed_max_m_s: Positive = 12.0
    climb_max_m_s: Positive = 2.5
    telemetry_after_s: NotNegative = 1.0
    """Until then it sends heartbeats only,"""
    ready_after_s: NotNegative = 2.0
    """and until then its estimator has no position and it refuses to arm."""
    arming_refusals: Annotated[int, Field(ge=0, le=1000)] = 0
    """How often it then still refuses to arm."""
    origin_spread_m: NotNegative = 20.0
    """The origin of each vehicle's local frame is drawn within this of the common one, north and east."""
    clock_jumps: tuple[ClockJump, ...] = ()


class Response(Part):
    """How a vehicle answers to set-points, as the control is designed for: acceleration a, velocity v.

    lag a' = a_set + gain (v_set - v) - a. Without it the vehicles of a scenario with dynamics `autopilot` are asked to
    show it before the formation flight.
    """

    lag_s: Positive
    velocity_gain_1_s: NotNegative = 0.0


class Scenario(Part):
    """One experiment: vehicles, wanted formation, control, links, seed, duration."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    duration_s: Annotated[float, Field(gt=0, le=86400)]
    altitude_m: NotNegative = 1000.0
    vehicles: Annotated[tuple[Vehicle, ...], Field(min_length=1, max_length=250)]
    nominal_velocity: Annotated[tuple[NominalVelocity, ...], Field(min_length=1)]
    limits: Limits = Limits()
    rates: Rates = Rates()
    control: Control = Control()
    onboard: Onboard = Onboard()
    links: Links = Links()
    clocks: Clocks = Clocks()
    safety: Safety = Safety()
    monitor: Monitor = Monitor()
    dynamics: Literal["double_integrator", "autopilot"] = "double_integrator"
    """What the vehicles are: the source's UAVs, which follow an acceleration at once and are launched in the air, or
    multicopters with an autopilot, which start on the ground."""
    autopilot: Autopilot = Autopilot()
    response: Response | None = None
    at_end: Literal["hold", "land"] = "hold"
    """What vehicles with an autopilot are told when the flight ends."""

    def leader_first(self) -> tuple[Vehicle, ...]:
        """Vehicles ordered so that each comes after the one it follows, by system id within a rank."""
        followers: dict[int | None, list[Vehicle]] = {}
        for vehicle in sorted(self.vehicles, key=lambda vehicle: vehicle.system_id):
            followers.setdefault(vehicle.follows, []).append(vehicle)
        ordered = list(followers[None])
        for vehicle in ordered:  # grows while it is walked: a breadth-first walk down the tree
            ordered += followers.get(vehicle.system_id, [])
        return tuple(ordered)

    def link_of(self, system_id: int) -> tuple[Link, Link]:
        """The (up, down) links of one vehicle."""
        return self.links.of(system_id)

    def nominal_velocity_at(self, time_s: float) -> Velocity:
        """v_d at a scenario time; before time zero it is the first entry's."""
        current = self.nominal_velocity[0]
        for entry in self.nominal_velocity:
            if entry.from_s <= time_s:
                current = entry
        return current.velocity_ne_m_s

    def with_link_delay(self, *, up_s: float | None, down_s: float | None) -> Self:
        """The same scenario with other constant link delays for every vehicle; None leaves a direction as it is.

        Delay points go; jitter, losses and channels stay.
        """

        def delayed(link: Link, delay_s: float | None) -> Link:
            return link if delay_s is None else link.model_copy(update={"delay_s": delay_s, "delay_points": ()})

        own = tuple(
            v.model_copy(update={"up": v.up and delayed(v.up, up_s), "down": v.down and delayed(v.down, down_s)})
            for v in self.links.vehicles
        )
        links = {"up": delayed(self.links.up, up_s), "down": delayed(self.links.down, down_s), "vehicles": own}
        return self.model_copy(update={"links": self.links.model_copy(update=links)})
