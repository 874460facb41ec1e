"""The scenario: one typed, frozen object that says everything a flight depends on.

Units are part of each key's name. Positions and velocities are in the horizontal plane of one local NED frame,
as pairs (north, east). All vehicles fly at one altitude: the formation control is planar.

Numbers are bounded where the messages (single precision) and the clocks (nanoseconds) can still tell them apart.
"""

from collections.abc import Callable
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
DRIFT_MAX_PPM = 1000.0
"""Most that a vehicle's clock may drift. What the station says of clocks, and the bounds it gives, hold up to this."""


class Part(BaseModel):
    """Base of every part of a scenario: unknown keys, wrong types, NaN and infinities are refused.

    The docstring under a key is its description in `scenario.schema.json` and in the reference of the documentation.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class Vehicle(Part):
    """One UAV: whom it follows, where it flies relative to that vehicle, and its state when the flight begins."""

    system_id: SystemId
    """MAVLink system id, different for each vehicle."""
    follows: SystemId | None = None
    """System id of the vehicle in front. Exactly one vehicle, the leader, omits it."""
    offset_ne_m: Position | None = None
    """Wanted position relative to the vehicle in front (minus the spacing d of thesis eq. 2.10); every vehicle but the
    leader needs it."""
    hears: tuple[SystemId, ...] = ()
    """Vehicles other than the one in front whose errors its command may use. Graph methods only."""
    position_ne_m: Position
    """Position when the flight begins; with an autopilot, the place on the ground from which it takes off."""
    velocity_ne_m_s: Velocity
    """Velocity when the flight begins."""
    flavour: Flavour | None = None
    """Autopilot of this vehicle, if it differs from `autopilot.flavour`. Only with `dynamics = "autopilot"`."""


class NominalVelocity(Part):
    """The formation's nominal velocity v_d from one scenario time until the next entry."""

    from_s: NotNegative
    """Scenario time at which this velocity begins; the first entry begins at 0."""
    velocity_ne_m_s: Velocity
    """The nominal velocity; a change is a step."""


class Limits(Part):
    """Limits of every vehicle. Omitted ones are off, except the minimum speed: the kinematics are singular at zero."""

    speed_min_m_s: Positive = 1.0
    """Least ground speed."""
    speed_max_m_s: Positive | None = None
    """Greatest ground speed."""
    acceleration_max_m_s2: Positive | None = None
    """Greatest horizontal acceleration."""
    turn_rate_max_rad_s: Positive | None = None
    """Greatest rate at which the heading changes."""


class Rates(Part):
    """How often things happen, in Hz."""

    control_hz: Rate = 50.0
    """Control ticks of the station; every vehicle is sent one set-point per tick."""
    telemetry_hz: Rate = 50.0
    """LOCAL_POSITION_NED messages from each vehicle."""
    timesync_hz: Annotated[float, Field(ge=0.01, le=50)] = 10.0
    """TIMESYNC exchanges with each vehicle. At most `control_hz`, because each control tick logs one round trip."""


class FixedGains(Part):
    """Gains to fly as given, the same on both axes: u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p."""

    K1: Number
    """Gain on the vehicle's own velocity error, 1/s."""
    K2: Number
    """Gain on the velocity error of the vehicle in front, 1/s."""
    K3: Number
    """Gain on the vehicle's own spacing error, 1/s²."""


class GainBlock(Part):
    """One block of the gain matrix K of u = K e: what the errors of one vehicle add to the command of one vehicle."""

    vehicle: SystemId
    """The vehicle whose command this is."""
    of: SystemId
    """The vehicle whose errors are used."""
    gain: tuple[tuple[Number, ...], tuple[Number, ...]]
    """Two rows, for the north and east command. Four columns: spacing error north and east (1/s²), velocity error north
    and east (1/s). For the errors of the leader, which has no spacing error, only the last two columns."""


class Control(Part):
    """How the gains are found, and where the loop is closed.

    Without any requirement or gains, a delay margin of 0.3 s is required. If a delay margin is required, the design
    maximises robustness; otherwise it maximises the delay margin. A requirement is met, or the design says why it
    cannot be.
    """

    method: Literal["inclusion", "graph-dk", "graph-lqr"] = "inclusion"
    """`inclusion`: every vehicle uses its own errors and the velocity error of the vehicle in front. `graph-lqr`
    (structured LQR) and `graph-dk` (the source's D-K type iteration): it uses all errors of these two vehicles and of
    those it `hears`."""
    loop: Literal["ground", "onboard"] = "ground"
    """`ground`: the station closes every loop, so all feedback is late. `onboard`: every vehicle feeds back its own
    errors at once, and the station streams only what depends on other vehicles (thesis eq. 5.1). On board,
    `string_peak_max` holds at every delay, and `delay_margin_s` bounds the vehicles' own gains as if the station closed
    their loop."""
    delay_margin_s: Positive | None = None
    """Requirement: least delay margin of the sampled loop."""
    alpha: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Requirement: least robustness bound (thesis eq. 3.29)."""
    decay_rate_1_s: Positive | None = None
    """Requirement: least decay rate of the continuous loop without delay."""
    string_peak_max: Factor = 1.0
    """Largest factor by which a spacing error may grow from one vehicle to the next at any frequency; 1 allows no
    growth."""
    gains: FixedGains | None = None
    """Fly these gains instead of designing any."""
    blocks: tuple[GainBlock, ...] = ()
    """Fly this gain matrix, given block by block, instead of designing one. Omitted blocks are zero."""


class Onboard(Part):
    """The loop on board each vehicle when `control.loop = "onboard"`, and its sensor for the vehicle in front."""

    rate_hz: Rate = 100.0
    """How often the vehicle computes its own part of the command; a whole multiple of `sensor_hz`."""
    sensor_hz: Rate = 50.0
    """How often the sensor measures the vehicle in front; a whole multiple of `rates.control_hz`. Between measurements
    the position is extrapolated with the relative velocity."""
    position_noise_m: NotNegative = 0.0
    """Standard deviation of the measured relative position on each axis: normal noise, independent between
    measurements."""
    velocity_noise_m_s: NotNegative = 0.0
    """Standard deviation of the measured relative velocity on each axis."""


class Jitter(Part):
    """A random delay drawn for each datagram and added to the link's delay; their sum is at least 0.

    uniform      from -scale_s to +scale_s: mean 0, standard deviation scale_s / sqrt(3)
    normal       mean 0, standard deviation scale_s
    exponential  from 0 up: mean and standard deviation scale_s
    gamma        from 0 up: mean shape * scale_s, standard deviation sqrt(shape) * scale_s
    trace        measured delays in their order, starting at a place drawn for each link and wrapping around
    """

    distribution: Literal["uniform", "normal", "exponential", "gamma", "trace"]
    """Kind of the distribution."""
    scale_s: Positive | None = None
    """Scale of the distribution; needed by all but `trace`."""
    shape: Positive | None = None
    """Shape of the gamma distribution; needed by `gamma` only."""
    trace_file: str | None = None
    """File of measured delays, relative to the scenario file: one delay in s per line, or CSV with a column `delay_s`.
    It is read with the scenario, which from then on holds the delays themselves in `trace_s`."""
    trace_s: tuple[NotNegative, ...] | None = None
    """The measured delays, in place of `trace_file`."""


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
    """The constant part of a link's delay at one time; linear between points. Two points at one time make a step."""

    at_s: NotNegative
    """Link time of the point."""
    delay_s: NotNegative
    """Delay at that time."""


class Outage(Part):
    """A time during which everything that enters the link is lost."""

    from_s: NotNegative
    """Link time at which the outage begins."""
    until_s: Positive
    """Link time at which it is over."""


class Link(Part):
    """One direction of a radio link. Times are link times, see `links.times_from`.

    A datagram meets, in this order: an outage or a full channel queue, which drops it; the channel, which takes time to
    send it; loss, or flipped bits; and the delay with its jitter, after which it arrives.
    """

    delay_s: NotNegative = 0.0
    """Constant one-way delay."""
    delay_points: tuple[DelayPoint, ...] = ()
    """A delay that changes over time, in place of `delay_s`. A datagram gets the delay of the time at which it
    enters."""
    jitter: Jitter | None = None
    """Random delay on top of the constant one."""
    reordering: bool = False
    """Whether a datagram may overtake an earlier one. If not, it waits for the earlier one."""
    loss_probability: Probability = 0.0
    """Probability that a datagram is lost, independently of the others."""
    loss_bursts: LossBursts | None = None
    """Loss in bursts, in addition to `loss_probability`."""
    duplicate_probability: Probability = 0.0
    """Probability that a datagram which arrives does so twice. The second copy has its own jitter."""
    corrupt_probability: Probability = 0.0
    """Probability that a datagram arrives with one to four of its bits flipped."""
    outages: tuple[Outage, ...] = ()
    """Times without any connection."""
    channel: str | None = None
    """Name of the entry of `links.channels` that this link uses; without it the bandwidth is unlimited."""


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
    """Most bytes that wait, not counting the datagram being sent; unlimited if omitted."""
    queue_datagrams: Annotated[int, Field(ge=0, le=10_000)] | None = None
    """Most datagrams that wait, not counting the one being sent; unlimited if omitted."""
    shared: bool = True
    """True: one channel for all vehicles whose links name it. False: each vehicle has a channel of its own."""
    half_duplex: bool = False
    """True: up and down share the bandwidth and the queue. False: each direction has its own."""


class Links(Part):
    """Emulated links: up is vehicle to station, down is station to vehicle."""

    up: Link = Link()
    """From each vehicle to the station."""
    down: Link = Link()
    """From the station to each vehicle."""
    vehicles: tuple[VehicleLinks, ...] = ()
    """Vehicles whose links differ."""
    channels: tuple[Channel, ...] = ()
    """Limited bandwidths that links may use."""
    times_from: Literal["flight", "start"] = "flight"
    """What link time, which outages and delay points refer to, counts from. `flight`: the station's first set-point
    enters a link; before that the first delay point applies and there is no outage. `start`: the vehicles start."""

    def of(self, system_id: int) -> tuple[Link, Link]:
        """The (up, down) links of one vehicle."""
        for own in self.vehicles:
            if own.system_id == system_id:
                return own.up or self.up, own.down or self.down
        return self.up, self.down


class Clocks(Part):
    """Boot clocks of the vehicles. Offset and drift of each are drawn from the seed within these bounds."""

    offset_max_s: Annotated[float, Field(ge=0, le=1e6)] = 100.0
    """Largest offset of a boot clock from the time at which the vehicles start."""
    drift_max_ppm: Annotated[float, Field(ge=0, le=DRIFT_MAX_PPM)] = 20.0
    """Largest deviation of a boot clock's rate."""


class Safety(Part):
    """When a vehicle enters its failsafe, when the flight is ended early, and what counts as settled."""

    setpoint_timeout_s: Positive = 1.0
    """A vehicle that gets no set-point for this long enters its failsafe."""
    heartbeat_timeout_s: Positive = 3.0
    """A vehicle that does not hear its ground station for this long enters its failsafe and may take commands from
    another."""
    spacing_error_limit_m: Positive = 1000.0
    """A larger spacing error ends the flight; the verdict is then `unstable`."""
    collision_distance_m: NotNegative = 5.0
    """Vehicles closer to each other than this have collided, which ends the flight."""
    settled_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """A follower has settled when its spacing error stays below this fraction of its spacing."""


class Monitor(Part):
    """When the station acts on a shrinking headroom (1 - loop delay / margin), and how."""

    act: bool = True
    """False: the modes are shown and nothing is done."""
    caution_headroom: Headroom = 0.3
    """A vehicle with less headroom is in CAUTION."""
    critical_headroom: Headroom = 0.15
    """A vehicle with less headroom is in CRITICAL, and the station acts."""
    hysteresis: NotNegative = 0.05
    """A mode is left again when headroom exceeds its threshold by this much."""
    window_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    """The monitor judges the loop delay that 90 % of the ticks in this window stay below."""
    hold_s: NotNegative = 0.3
    """How long a condition must last before the monitor changes to slower gains."""
    ease_s: NotNegative = 3.0
    """How long a condition must last before the monitor returns to faster gains."""
    blend_s: Positive = 1.0
    """How long a change of gains takes."""
    time_scales: Annotated[tuple[Factor, ...], Field(min_length=1, max_length=8)] = (
        1.0,
        2.0,
        4.0,
    )
    """The gain schedule: the design slowed down in time by each factor, which multiplies its delay margin by it."""
    open_factor: Factor = 1.5
    """When even the slowest gains have too little headroom, every spacing is multiplied by this."""
    open_s: Positive = 10.0
    """How long opening the formation takes."""


class ClockJump(Part):
    """The boot clock of every vehicle jumps, as in a simulator that cannot keep up."""

    at_s: Positive
    """Time since the vehicles were started."""
    by_s: Number
    """How far the clock jumps; forwards if positive."""


class Autopilot(Part):
    """A simulated multicopter, with `dynamics = "autopilot"`: how it starts, and how it responds to set-points.

    It stands on the ground at its position until it is told to take off. It wants the acceleration of the set-point
    plus `velocity_gain_1_s` times its velocity error; its real acceleration follows with a first-order lag.
    """

    flavour: Flavour = "ardupilot"
    """Whose modes, numbers and rules it follows: ArduCopter's or PX4's."""
    lag_s: Positive = 0.15
    """Time constant from the wanted to the real acceleration."""
    velocity_gain_1_s: Positive = 2.0
    """Gain from velocity error to wanted acceleration."""
    acceleration_max_m_s2: Positive = 5.0
    """Greatest acceleration."""
    speed_max_m_s: Positive = 12.0
    """Greatest horizontal speed."""
    climb_max_m_s: Positive = 2.5
    """Greatest climb rate."""
    telemetry_after_s: NotNegative = 1.0
    """Time after start-up during which it sends only heartbeats."""
    ready_after_s: NotNegative = 2.0
    """Time after start-up during which its estimator has no position and it refuses to arm."""
    arming_refusals: Annotated[int, Field(ge=0, le=1000)] = 0
    """How many more arming requests it refuses after that."""
    origin_spread_m: NotNegative = 20.0
    """The origin of each vehicle's local frame is drawn within this distance of the common one, north and east."""
    clock_jumps: tuple[ClockJump, ...] = ()
    """Jumps of the boot clock."""


class Response(Part):
    """How every vehicle responds to set-points, with acceleration a and velocity v.

    lag a' = a_set + gain (v_set - v) - a. The control is designed for it. Without it, the response of vehicles with
    `dynamics = "autopilot"` is identified in a manoeuvre before the formation flight.
    """

    lag_s: Positive
    """Time constant from set-point to acceleration."""
    velocity_gain_1_s: NotNegative = 0.0
    """Gain from velocity error to acceleration."""


class Scenario(Part):
    """One experiment: vehicles, wanted formation, control, links, seed, duration."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    """Name of the scenario; the run's folder begins with it."""
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    """Seed of everything random: each link and each vehicle draws from a stream of its own."""
    duration_s: Annotated[float, Field(gt=0, le=86400)]
    """How long the formation is flown."""
    altitude_m: NotNegative = 1000.0
    """Altitude of all vehicles above the origin."""
    vehicles: Annotated[tuple[Vehicle, ...], Field(min_length=1, max_length=250)]
    """The formation: one tree, whose root is the leader."""
    nominal_velocity: Annotated[tuple[NominalVelocity, ...], Field(min_length=1)]
    """The formation's velocity over time, as steps in order of time."""
    limits: Limits = Limits()
    """What the vehicles can do."""
    rates: Rates = Rates()
    """How often things happen."""
    control: Control = Control()
    """How the gains are found, and where the loop is closed."""
    onboard: Onboard = Onboard()
    """The loop on board, with `control.loop = "onboard"`."""
    links: Links = Links()
    """The emulated radio links."""
    clocks: Clocks = Clocks()
    """The vehicles' boot clocks."""
    safety: Safety = Safety()
    """Time-outs and limits."""
    monitor: Monitor = Monitor()
    """What the station does when headroom shrinks."""
    dynamics: Literal["double_integrator", "autopilot"] = "double_integrator"
    """`double_integrator`: the source's UAVs, which follow an acceleration at once and are launched in the air.
    `autopilot`: multicopters with an autopilot, which start on the ground."""
    autopilot: Autopilot = Autopilot()
    """The simulated multicopters, with `dynamics = "autopilot"`."""
    response: Response | None = None
    """How the vehicles respond to set-points, if that is known beforehand."""
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

    def with_calm_monitor(self) -> Self:
        """The same scenario with a monitor that only watches, and without slower gains to switch to."""
        monitor = self.monitor.model_copy(update={"act": False, "time_scales": (1.0,)})
        return self.model_copy(update={"monitor": monitor})

    def with_link_delay(self, *, up_s: float | None, down_s: float | None) -> Self:
        """The same scenario with other constant link delays for every vehicle; None leaves a direction as it is.

        Delay points are dropped; jitter, losses and channels stay.
        """

        def delayed(delay_s: float | None) -> Callable[[Link], Link]:
            changed = {} if delay_s is None else {"delay_s": delay_s, "delay_points": ()}
            return lambda link: link.model_copy(update=changed)

        return self.with_links(delayed(up_s), delayed(down_s))

    def with_links(self, change_up: Callable[[Link], Link], change_down: Callable[[Link], Link]) -> Self:
        """The same scenario with every up link and every down link changed."""
        own = tuple(
            v.model_copy(update={"up": v.up and change_up(v.up), "down": v.down and change_down(v.down)})
            for v in self.links.vehicles
        )
        links = {"up": change_up(self.links.up), "down": change_down(self.links.down), "vehicles": own}
        return self.model_copy(update={"links": self.links.model_copy(update=links)})
