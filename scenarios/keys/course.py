"""The course that a formation flies and the shape it takes on the way, as the file describes them."""

from typing import Annotated, Literal

from pydantic import Field

from scenarios.keys.part import NotNegative, Part, Position, Positive, SystemId


class Course(Part):
    """Smooth courses, offsets that turn with the course, and a leader flown by somebody else.

    Without any of these keys `nominal_velocity` is flown as steps, and offsets stay fixed in north and east.
    """

    waypoints_ne_m: tuple[Position, ...] = ()
    """Waypoints of the leader's course, in place of `nominal_velocity`. The course starts at the first, rounds each of
    the others on the inside, and goes straight on after the last."""
    speed_m_s: Positive | None = None
    """Speed along the waypoints."""
    acceleration_max_m_s2: Positive | None = None
    """Largest acceleration of the nominal velocity. With it every change of the nominal velocity is smooth: heading and
    speed change by 10 x³ - 15 x⁴ + 6 x⁵ over the shortest time that keeps the bounds, and every vehicle is sent the
    acceleration that this needs. Required with waypoints."""
    jerk_max_m_s3: Positive | None = None
    """Largest rate of change of that acceleration; if omitted, only the acceleration bounds the changes."""
    offsets: Literal["fixed", "heading"] = "fixed"
    """`fixed`: offsets are north and east. `heading`: they are forward and right of the nominal velocity's heading and
    turn with it; every vehicle is sent the acceleration that this needs."""
    leader: Literal["station", "external"] = "station"
    """`station`: the station flies the leader along the course. `external`: somebody else flies it, the station asks it
    for telemetry and commands nothing, and its measured velocity is the nominal velocity. A simulated external leader
    flies the course by itself."""

    @property
    def is_smooth(self) -> bool:
        """Whether changes of the nominal velocity take time."""
        return self.acceleration_max_m_s2 is not None


class ChangedOffset(Part):
    """The new offset of one vehicle."""

    system_id: SystemId
    """A vehicle that follows another."""
    offset_ne_m: Position
    """Its new offset, in place of the vehicle's `offset_ne_m`."""


class FormationChange(Part):
    """A smooth change of offsets, by 10 x³ - 15 x⁴ + 6 x⁵ over a given time.

    Every vehicle is sent the acceleration that this needs.
    """

    at_s: NotNegative
    """Scenario time at which the change begins, after the end of the one before."""
    duration_s: Positive
    """How long it takes."""
    offsets: Annotated[tuple[ChangedOffset, ...], Field(min_length=1)]
    """The vehicles whose offsets change; the others keep theirs."""
