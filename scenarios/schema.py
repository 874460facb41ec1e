"""The scenario: one typed, frozen object that says everything a flight depends on.

Units are part of each key's name. Positions and velocities are in the horizontal plane of one local NED frame,
as pairs (north, east): the formation control is planar. Each vehicle keeps an altitude of its own.

The docstring below a key describes it in `scenario.schema.json` and the reference. Larger parts: `scenarios.keys`.
"""

from collections.abc import Callable
from math import ceil, inf
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field
from pydantic.json_schema import SkipJsonSchema

from scenarios.errors import ScenarioError
from scenarios.keys.autopilot import DeadTime, Response, Sitl
from scenarios.keys.course import Course, FormationChange
from scenarios.keys.criteria import Criteria, Overlap
from scenarios.keys.disturbance import Disturbance, Navigation
from scenarios.keys.link import Link, Links
from scenarios.keys.own import CodeFile, CodeName, Dynamics
from scenarios.keys.part import (
    Factor,
    Flavour,
    Headroom,
    NotNegative,
    Number,
    Part,
    Position,
    Positive,
    Prediction,
    Rate,
    SystemId,
    Velocity,
)
from scenarios.keys.rates import Rates
from scenarios.networks import MOST_VEHICLES
from scenarios.smooth import Bounds, SmoothCourse, course_by_steps, course_by_waypoints

NS_PER_S = 1_000_000_000
DRIFT_MAX_PPM = 1000.0
"""Largest drift of a vehicle's clock. The station's clock estimates and their bounds hold up to it."""


class Vehicle(Part):
    """One UAV: whom it follows, where it flies relative to that vehicle, and its state when the flight begins."""

    system_id: SystemId
    """MAVLink system id, 1 to 250, different for each vehicle. For a vehicle in network 1 to 9, add 1000 times the
    number of the network: 2017 is system 17 of network 2, which has a UDP port of its own."""
    follows: SystemId | None = None
    """System id of the vehicle in front. Exactly one vehicle, the leader, omits it."""
    offset_ne_m: Position | None = None
    """Wanted position relative to the vehicle in front (the negative of the spacing d of thesis eq. 2.10); required for
    every vehicle but the leader."""
    hears: tuple[SystemId, ...] = ()
    """Vehicles other than the one in front whose errors its command may use. Graph methods only."""
    position_ne_m: Position
    """Position when the flight begins; with an autopilot, the place on the ground from which it takes off."""
    velocity_ne_m_s: Velocity
    """Velocity when the flight begins."""
    altitude_m: NotNegative | None = None
    """Altitude of this vehicle above the origin, if it differs from `altitude_m` of the scenario."""
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
    """Minimum ground speed; not for `dynamics = "autopilot"`, as multicopters can hover."""
    speed_max_m_s: Positive | None = None
    """Maximum ground speed."""
    acceleration_max_m_s2: Positive | None = None
    """Maximum horizontal acceleration."""
    turn_rate_max_rad_s: Positive | None = None
    """Maximum rate at which the heading changes."""


class FixedGains(Part):
    """Gains to fly as given, the same on both axes: u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p."""

    K1: Number
    """Gain on the vehicle's own velocity error, 1/s."""
    K2: Number
    """Gain on the velocity error of the vehicle in front, 1/s."""
    K3: Number
    """Gain on the vehicle's own spacing error, 1/s²."""


class GainBlock(Part):
    """One block of the gain matrix K of u = K e: the part of one vehicle's command due to one vehicle's errors."""

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
    maximises robustness; otherwise it maximises the delay margin. The design meets every requirement, or says why it
    cannot.
    """

    method: Literal["inclusion", "graph-dk", "graph-lqr", "python"] = "inclusion"
    """`inclusion`: every vehicle uses its own errors and the velocity error of the vehicle in front. `graph-lqr`
    (structured LQR) and `graph-dk` (the D-K type iteration of the thesis): every vehicle uses all errors of itself, the
    vehicle in front and those it `hears`. `python`: the `controller` computes all commands."""
    controller: CodeName | None = None
    """With `method = "python"`: the control law, a function in a Python file beside this one, such as
    `"my_law.py:law"`. Commands run it only with `--allow-code`."""
    linear: CodeName | None = None
    """Declares that the controller is linear, u = K e: a function in a Python file that returns K. The delay margin is
    then computed."""
    loop: Literal["ground", "onboard"] = "ground"
    """`ground`: the station closes every loop, so all feedback is delayed. `onboard`: every vehicle feeds back its own
    errors at once, and the station streams only what depends on other vehicles (thesis eq. 5.1). On board,
    `string_peak_max` holds at every delay, and `delay_margin_s` limits the vehicles' own gains as if the station closed
    their loop."""
    delay_margin_s: Annotated[float, Field(gt=0, le=30)] | None = None
    """Requirement: least delay margin of the sampled loop."""
    alpha: Annotated[float, Field(ge=5e-4, lt=1)] | None = None
    """Requirement: least robustness bound (thesis eq. 3.29)."""
    decay_rate_1_s: Positive | None = None
    """Requirement: least decay rate of the continuous loop without delay."""
    string_peak_max: Factor = 1.0
    """Largest factor by which a spacing error may grow from one vehicle to the next at any frequency; 1 allows no
    growth."""
    criteria: Criteria | None = None
    """Further requirements, and the loop delay for which the gains are optimised."""
    overlap: Overlap | None = None
    """Which vehicles every vehicle hears besides the one in front; graph methods only."""
    gains: FixedGains | None = None
    """Fly these gains instead of designing any."""
    blocks: tuple[GainBlock, ...] = ()
    """Fly this gain matrix, given block by block, instead of designing one. Omitted blocks are zero."""
    feed_forward: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Fraction of the command of the vehicle in front, computed in the same tick, that is added to each follower's
    command. Gains are designed for it; margins do not depend on it. Only with `method = "inclusion"`, without `blocks`,
    `criteria` and `for_link`, and with `loop = "ground"`. With 1 and K2 = -K1 a follower moves as the one in front."""
    prediction: Prediction = "off"
    """The loop delay over which the station predicts each vehicle from its newest state and the set-points that act
    after it. A number: a fixed delay in seconds. `measured`: the smoothed delay measured for each vehicle; the assumed
    delay changes by at most 0.1 s per second. `off`: the newest states are fed back as they are. With `loop =
    "onboard"` the station predicts what it streams. With `dynamics = "autopilot"` the file must give the `response`,
    which is part of the prediction."""
    execute_at: bool = False
    """True: a vehicle holds each set-point until a fixed time after its stamp, by which 99 % of the last 500 arrived.
    Jitter then becomes constant delay. Not with `dynamics = "autopilot"`."""
    for_link: Literal["off", "measured"] = "off"
    """`measured`: the gains of the inclusion principle, and whether to predict, are chosen for the links as `gcs fly`
    measures them before the flight, or as a log shows them (`--links-of`). `criteria` and `string_peak_max` then hold
    at the measured delays. With `dynamics = "autopilot"` the file must give the `response`."""
    link_headroom: Annotated[float, Field(ge=0, lt=1)] = 0.3
    """With `for_link`: the headroom to keep at the worst delay of the measured links."""


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
    ready_patience_s: Annotated[float, Field(gt=0, le=360)] = 120.0
    """Time that a vehicle with an autopilot has to become ready for set-points in the air, from its first heartbeat or,
    if it is never heard, from the start. After that, the others fly without it."""
    spacing_error_limit_m: Positive = 1000.0
    """A larger spacing error ends the flight; the verdict is then `unstable`."""
    collision_distance_m: NotNegative = 5.0
    """Vehicles closer to each other than this have collided, which ends the flight."""
    settled_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """A follower has settled when its spacing error stays below this fraction of its spacing, at least for the last 5 %
    of the flight."""


class Monitor(Part):
    """When and how the station acts on a shrinking headroom (1 - loop delay / margin)."""

    act: bool = True
    """False: the modes are shown, but the station takes no action."""
    caution_headroom: Headroom = 0.3
    """A vehicle with less headroom is in CAUTION."""
    critical_headroom: Headroom = 0.15
    """A vehicle with less headroom is in CRITICAL, and the station acts."""
    hysteresis: NotNegative = 0.05
    """A mode ends when the headroom exceeds its threshold by this much."""
    window_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    """The monitor judges the 90th percentile of the loop delay over the ticks in this window."""
    hold_s: NotNegative = 0.3
    """How long a condition must last before the monitor changes to slower gains."""
    ease_s: NotNegative = 3.0
    """How long a condition must last before the monitor returns to faster gains."""
    blend_s: Positive = 1.0
    """How long a change of gains takes."""
    time_scales: Annotated[tuple[Factor, ...], Field(min_length=1, max_length=8)] = (1.0, 2.0, 4.0)
    """The gain schedule: the design slowed down in time by each factor. If vehicles respond at once, the factor also
    multiplies the delay margin."""
    open_factor: Factor = 1.5
    """Factor on every spacing when even the slowest gains have too little headroom."""
    open_s: Positive = 10.0
    """How long opening the formation takes."""


class ClockJump(Part):
    """A jump of every vehicle's boot clock, as in a simulator that cannot keep up."""

    at_s: Positive
    """Time since the vehicles were started."""
    by_s: Number
    """How far the clock jumps; forwards if positive."""


class Autopilot(Part):
    """A simulated multicopter, with `dynamics = "autopilot"`: how it starts, and how it responds to set-points.

    It stands on the ground at its position until it is commanded to take off. The acceleration it aims at is that of
    the set-point plus `velocity_gain_1_s` times its velocity error; its actual acceleration follows it by one of
    the models of `[response]`, by default with a first-order lag.
    """

    flavour: Flavour = "ardupilot"
    """Whether it has the modes, messages and rules of ArduCopter or of PX4."""
    lag_s: Positive = 0.15
    """Time constant of the lag."""
    velocity_gain_1_s: Positive = 2.0
    """Gain from velocity error to acceleration."""
    dead_time_s: DeadTime = 0.0
    """Dead time before the lag, as in `[response]`."""
    natural_frequency_rad_s: Positive | None = None
    """Selects the second-order model, as in `[response]`."""
    acceleration_max_m_s2: Positive = 5.0
    """Maximum acceleration."""
    jerk_max_m_s3: Positive | None = None
    """Maximum rate of change of the acceleration that it aims at; unlimited if omitted."""
    speed_max_m_s: Positive = 12.0
    """Maximum horizontal speed."""
    drag_1_m: NotNegative = 0.0
    """Drag coefficient: the deceleration by the air, divided by the square of the horizontal speed."""
    climb_max_m_s: Positive = 2.5
    """Maximum climb rate."""
    telemetry_after_s: NotNegative = 1.0
    """Time after start-up during which it sends only heartbeats."""
    ready_after_s: NotNegative = 2.0
    """Time after start-up during which its estimator has no position and it refuses to arm."""
    arming_refusals: Annotated[int, Field(ge=0, le=1000)] = 0
    """How many arming requests it refuses after `ready_after_s`."""
    origin_spread_m: NotNegative = 20.0
    """Each vehicle's local frame has an origin drawn within ± this distance of the common one: north, east and up."""
    clock_jumps: tuple[ClockJump, ...] = ()
    """Jumps of the boot clock."""
    sitl: Sitl = Sitl()
    """Clock errors of autopilots in SITL."""


class Scenario(Part):
    """One experiment: vehicles, wanted formation, control, links, seed, duration."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    """Name of the scenario; the run's folder begins with it."""
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    """Seed of everything random: each link and each vehicle draws from a stream of its own."""
    duration_s: Annotated[float, Field(gt=0, le=86400)]
    """How long the formation is flown."""
    altitude_m: NotNegative = 1000.0
    """Altitude above the origin, for vehicles without one of their own; required with dynamics autopilot, which takes
    off to it."""
    vehicles: Annotated[tuple[Vehicle, ...], Field(min_length=1, max_length=MOST_VEHICLES)]
    """The formation: one tree, whose root is the leader."""
    nominal_velocity: tuple[NominalVelocity, ...] = ()
    """The formation's velocity over time, as steps in order of time; required without `course.waypoints_ne_m`."""
    course: Course = Course()
    """Smooth courses, offsets that turn with the course, and a leader flown by somebody else."""
    formation_changes: tuple[FormationChange, ...] = ()
    """Changes of offsets in flight, in order of time."""
    limits: Limits = Limits()
    """Limits of the vehicles' motion."""
    rates: Rates = Rates()
    """How often the station and the vehicles compute and send."""
    control: Control = Control()
    """How the gains are found, and where the loop is closed."""
    onboard: Onboard = Onboard()
    """The loop on board, with `control.loop = "onboard"`."""
    links: Links = Links()
    """The emulated radio links."""
    clocks: Clocks = Clocks()
    """The vehicles' boot clocks."""
    safety: Safety = Safety()
    """Timeouts and limits."""
    monitor: Monitor = Monitor()
    """When and how the station acts on a shrinking headroom."""
    dynamics: Dynamics = "double_integrator"
    """`double_integrator`: the UAVs of the thesis, which follow an acceleration at once and are launched in the air.
    `autopilot`: multicopters with an autopilot, which start on the ground. A function in a Python file, such as
    `"my_model.py:step"`: vehicles launched in the air that move as it says; run only with `--allow-code`. `jsbsim`:
    aircraft with six degrees of freedom and an autopilot, launched in the air; `"jsbsim:f16"` names another model of
    that package than its T-6 Texan II."""
    autopilot: Autopilot = Autopilot()
    """The simulated multicopters, with `dynamics = "autopilot"`."""
    response: Response | None = None
    """How the vehicles respond to set-points, if that is known beforehand."""
    disturbance: Disturbance | None = None
    """Pushes on the vehicles in flight: wind, gusts, or a disturbance that depends on the formation's errors."""
    navigation: Navigation | None = None
    """Errors of the positions and velocities that vehicles report."""
    at_end: Literal["hold", "land"] = "hold"
    """Command to vehicles with an autopilot when the flight ends."""
    code: SkipJsonSchema[tuple[CodeFile, ...]] = ()
    """No key: the Python files that other keys name, filled in when the scenario is read."""

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
        links = self.links
        for own in links.vehicles:
            if own.system_id == system_id:
                return own.up or links.up, own.down or links.down
        return links.up, links.down

    def nominal_velocity_at(self, time_s: float) -> Velocity:
        """v_d at a scenario time; before time zero it is that at time zero."""
        if self.course.is_smooth:
            return self.smooth_course().at(time_s).velocity_ne_m_s
        current = self.nominal_velocity[0]
        for entry in self.nominal_velocity:
            if entry.from_s <= time_s:
                current = entry
        return current.velocity_ne_m_s

    def smooth_course(self) -> SmoothCourse:
        """The course with bounded accelerations, if `course.acceleration_max_m_s2` is given.

        Raises scenarios.smooth.TooShortError if waypoints are too close to each other for the turns between them.
        """
        course = self.course
        assert course.acceleration_max_m_s2 is not None
        bounds = Bounds(course.acceleration_max_m_s2, course.jerk_max_m_s3)
        if course.speed_m_s is not None:
            return course_by_waypoints(bounds, course.waypoints_ne_m, course.speed_m_s)
        return course_by_steps(bounds, tuple((entry.from_s, entry.velocity_ne_m_s) for entry in self.nominal_velocity))

    @property
    def external_id(self) -> int | None:
        """System id of the leader if somebody else flies it."""
        return self.leader_first()[0].system_id if self.course.leader == "external" else None

    @property
    def manoeuvres(self) -> bool:
        """Whether the planned motion is more than steps of the nominal velocity in one shape."""
        return self.course.is_smooth or self.course.leader == "external" or bool(self.formation_changes)

    def altitude_of(self, vehicle: Vehicle) -> float:
        """The altitude at which a vehicle flies, in m above the origin."""
        return self.altitude_m if vehicle.altitude_m is None else vehicle.altitude_m

    @property
    def target_hz(self) -> float:
        """Rate at which each vehicle is asked for its active target; 0 for never."""
        if self.control.prediction == "off" or self.control.loop == "onboard":
            return 0.0  # on board, targets do not show which set-point acted
        return min(self.rates.target_hz, self.rates.telemetry_hz)

    @property
    def starts_on_ground(self) -> bool:
        """Whether the vehicles take off: those with an autopilot do, all others are launched in the air."""
        return self.dynamics == "autopilot"

    @property
    def simulated_autopilot(self) -> Autopilot | None:
        """The autopilot of the simulated vehicles; None if they have none."""
        return self.autopilot if self.dynamics == "autopilot" else None

    @property
    def has_altitude_slots(self) -> bool:
        """Whether vehicles fly at different altitudes."""
        return len({self.altitude_of(vehicle) for vehicle in self.vehicles}) > 1

    def in_steady_flight(self) -> Self:
        """The same scenario without manoeuvres: the nominal velocity and the offsets stay as they are at time zero."""
        heading = self.course.offsets == "heading"
        steady = NominalVelocity(from_s=0.0, velocity_ne_m_s=self.nominal_velocity_at(0.0))
        course = (
            Course(offsets="heading", acceleration_max_m_s2=self.course.acceleration_max_m_s2) if heading else Course()
        )
        return self.model_copy(update={"nominal_velocity": (steady,), "course": course, "formation_changes": ()})

    def with_calm_monitor(self) -> Self:
        """The same scenario with a monitor that only watches, and without slower gains to switch to."""
        return self.with_keys(monitor={"act": False, "time_scales": (1.0,)})

    def with_keys(self, **parts: dict[str, Any]) -> Self:
        """The same scenario with some keys of its parts changed, unchecked: `with_keys(control={"alpha": 0.9})`."""
        changed = {part: getattr(self, part).model_copy(update=keys) for part, keys in parts.items()}
        return self.model_copy(update=changed)

    def at_rates(self, *, control_hz: float, telemetry_hz: float) -> Self:
        """The same scenario with other rates of control and telemetry.

        Sensor and loop on board run at the lowest multiples of the control rate that are no slower than before.
        """
        changed = self.with_keys(rates={"control_hz": control_hz, "telemetry_hz": telemetry_hz})
        if self.control.loop != "onboard":
            return changed
        sensor_hz = control_hz * ceil(self.onboard.sensor_hz / control_hz)
        own_hz = sensor_hz * ceil(self.onboard.rate_hz / sensor_hz)
        return changed.with_keys(onboard={"sensor_hz": sensor_hz, "rate_hz": own_hz})

    def with_link_delay(self, *, up_s: float | None, down_s: float | None) -> Self:
        """The same scenario with other constant link delays for every vehicle; None leaves a direction as it is.

        Delay points are dropped; jitter, losses and channels stay. ScenarioError unless a delay is a number from 0.
        """
        for key, value in (("up_s", up_s), ("down_s", down_s)):
            if value is not None and not 0.0 <= value < inf:
                raise ScenarioError(Path(self.name), key, value, "a delay in seconds, from 0")

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
        return self.with_keys(links=links)
