"""The scenario: one typed, frozen object that says everything a flight depends on.

Units are part of each key's name. Positions and velocities are in the horizontal plane of one local NED frame,
as pairs (north, east). All vehicles fly at one altitude: the formation control is planar.
"""

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

Pair = tuple[float, float]
SystemId = Annotated[int, Field(ge=1, le=250)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Rate = Annotated[float, Field(ge=1, le=500)]
NS_PER_S = 1_000_000_000


class Part(BaseModel):
    """Base of every part of a scenario: unknown keys, wrong types, NaN and infinities are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Vehicle(Part):
    """One UAV: whom it follows, where it flies relative to that vehicle, and its state when the flight begins."""

    system_id: SystemId
    follows: SystemId | None = None
    """System id of the vehicle in front; the one vehicle without it is the leader."""
    offset_ne_m: Pair | None = None
    """Wanted position relative to the vehicle in front (minus the spacing d of thesis eq. 2.10)."""
    position_ne_m: Pair
    velocity_ne_m_s: Pair


class NominalVelocity(Part):
    """The formation's velocity v_d from a scenario time on, until the next entry."""

    from_s: NotNegative
    velocity_ne_m_s: Pair


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
    timesync_hz: Annotated[float, Field(gt=0, le=50)] = 10.0


class FixedGains(Part):
    """Gains to be flown as they are, per axis: u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p."""

    K1: float
    K2: float
    K3: float


class Control(Part):
    """How the gains are found and where the loop is closed.

    With neither requirement nor gains, a delay margin of 0.3 s is required. One requirement given: the other quantity
    is made as large as possible. Both given: both are met or the design says that they cannot be.
    """

    method: Literal["inclusion"] = "inclusion"
    loop: Literal["ground"] = "ground"
    delay_margin_s: Positive | None = None
    """Least delay margin of the sampled loop."""
    alpha: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Least robustness bound (thesis eq. 3.29)."""
    string_peak_max: Annotated[float, Field(ge=1)] = 1.0
    """Most that spacing errors may grow from one vehicle to the next, whatever their frequency: with 1 not at all."""
    gains: FixedGains | None = None


class Link(Part):
    """One direction of a radio link."""

    delay_s: NotNegative = 0.0


class VehicleLinks(Part):
    """The links of one vehicle, where they differ from those of the others."""

    system_id: SystemId
    up: Link | None = None
    down: Link | None = None


class Links(Part):
    """Emulated links: up is vehicle to station, down is station to vehicle."""

    up: Link = Link()
    down: Link = Link()
    vehicles: tuple[VehicleLinks, ...] = ()


class Clocks(Part):
    """Boot clocks of the vehicles: offset and drift are drawn from the seed within these bounds."""

    offset_max_s: Annotated[float, Field(ge=0, le=1e6)] = 100.0
    drift_max_ppm: Annotated[float, Field(ge=0, le=1e4)] = 20.0


class Safety(Part):
    """When a vehicle helps itself, when the flight is ended early, and what counts as settled."""

    setpoint_timeout_s: Positive = 1.0
    heartbeat_timeout_s: Positive = 3.0
    spacing_error_limit_m: Positive = 1000.0
    settled_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """A follower has settled when its spacing error is below this part of its spacing."""


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
    links: Links = Links()
    clocks: Clocks = Clocks()
    safety: Safety = Safety()

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
        for own in self.links.vehicles:
            if own.system_id == system_id:
                return own.up or self.links.up, own.down or self.links.down
        return self.links.up, self.links.down

    def nominal_velocity_at(self, time_s: float) -> Pair:
        """v_d at a scenario time; before time zero it is the first entry's."""
        current = self.nominal_velocity[0]
        for entry in self.nominal_velocity:
            if entry.from_s <= time_s:
                current = entry
        return current.velocity_ne_m_s

    def with_link_delay(self, *, up_s: float | None, down_s: float | None) -> Self:
        """The same scenario with other constant link delays for every vehicle; None leaves a direction as it is."""
        up = self.links.up if up_s is None else Link(delay_s=up_s)
        down = self.links.down if down_s is None else Link(delay_s=down_s)
        own = tuple(
            VehicleLinks(
                system_id=v.system_id,
                up=v.up if up_s is None else None,
                down=v.down if down_s is None else None,
            )
            for v in self.links.vehicles
        )
        return self.model_copy(update={"links": Links(up=up, down=down, vehicles=own)})
