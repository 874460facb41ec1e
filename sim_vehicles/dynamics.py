"""One UAV: planar kinematics under the on-board feedback linearisation, with limits, integrated by RK4.

    X' = V cos ψ,   Y' = V sin ψ,   ψ' = ω,   V' = a                                   (thesis eq. 2.2-2.4)
    (a, ω) = M(ξ) u,   M = [[cos ψ, sin ψ], [-sin ψ / V, cos ψ / V]]                   (thesis eq. 2.6)

u is the wanted acceleration (north, east). While no limit binds, the vehicle is exactly a planar double integrator.
M is evaluated in every stage of the integration: the on-board loop is continuous, not sampled.

Scalars and plain functions, because this is called for every sample and every set-point of every vehicle.
"""

import math
from typing import NamedTuple

from scenarios import schema

LONGEST_STEP_S = 0.02
VELOCITY_GAIN_1_S = 2.0
"""Gain of the velocity feedback when a set-point carries velocity as well as acceleration: time constant 0.5 s."""


class State(NamedTuple):
    """Where the vehicle is; yaw is clockwise from north and is not wrapped."""

    north_m: float
    east_m: float
    yaw_rad: float
    speed_m_s: float

    def velocity_ne_m_s(self) -> tuple[float, float]:
        """Velocity over ground (north, east)."""
        return self.speed_m_s * math.cos(self.yaw_rad), self.speed_m_s * math.sin(self.yaw_rad)


class Command(NamedTuple):
    """What the vehicle tries to do: u = acceleration + gain (velocity - own velocity), each (north, east)."""

    acceleration_north_m_s2: float = 0.0
    acceleration_east_m_s2: float = 0.0
    velocity_north_m_s: float = 0.0
    velocity_east_m_s: float = 0.0
    velocity_gain_1_s: float = 0.0


COAST = Command()
"""Constant velocity, wings level."""


class Bounds(NamedTuple):
    """The limits as numbers; one that is off is infinite."""

    speed_min_m_s: float
    speed_max_m_s: float
    acceleration_max_m_s2: float
    turn_rate_max_rad_s: float


def bounds_of(limits: schema.Limits) -> Bounds:
    """The scenario's limits in the form the integration wants."""
    return Bounds(
        limits.speed_min_m_s,
        limits.speed_max_m_s or math.inf,
        limits.acceleration_max_m_s2 or math.inf,
        limits.turn_rate_max_rad_s or math.inf,
    )


def state_from(position_ne_m: tuple[float, float], velocity_ne_m_s: tuple[float, float]) -> State:
    """The state of a vehicle at a position with a velocity over ground."""
    north, east = velocity_ne_m_s
    return State(*position_ne_m, math.atan2(east, north), math.hypot(north, east))


def advance(state: State, command: Command, bounds: Bounds, duration_s: float) -> State:
    """The state `duration_s` later, the command held; steps of at most 20 ms."""
    steps = max(1, math.ceil(duration_s / LONGEST_STEP_S))
    step_s = duration_s / steps
    for _ in range(steps):
        if _is_free(state.speed_m_s, command, bounds, step_s):
            state = _free_step(state, command[0], command[1], step_s)
        else:
            state = _limited_step(state, command, bounds, step_s)
    return state


def _is_free(speed: float, command: Command, bounds: Bounds, h: float) -> bool:
    """Whether u is constant and no limit can bind in any stage of a step."""
    speed_min, speed_max, acceleration_max, turn_rate_max = bounds
    wanted = math.hypot(command[0], command[1])
    slowest = speed - wanted * h
    return (
        command[4] == 0.0
        and wanted <= acceleration_max
        and slowest > speed_min
        and speed + wanted * h < speed_max
        and wanted <= turn_rate_max * slowest
    )


def _free_step(state: State, u_north: float, u_east: float, h: float) -> State:
    """A Runge-Kutta step without feedback or limits: most steps are of this kind, so it is written out."""
    north, east, yaw, v1 = state
    half, sixth = 0.5 * h, h / 6.0
    # Position does not enter the rates, so only yaw and speed have stage values.
    c1, s1 = math.cos(yaw), math.sin(yaw)
    a1, w1 = c1 * u_north + s1 * u_east, (c1 * u_east - s1 * u_north) / v1
    v2, yaw2 = v1 + half * a1, yaw + half * w1
    c2, s2 = math.cos(yaw2), math.sin(yaw2)
    a2, w2 = c2 * u_north + s2 * u_east, (c2 * u_east - s2 * u_north) / v2
    v3, yaw3 = v1 + half * a2, yaw + half * w2
    c3, s3 = math.cos(yaw3), math.sin(yaw3)
    a3, w3 = c3 * u_north + s3 * u_east, (c3 * u_east - s3 * u_north) / v3
    v4, yaw4 = v1 + h * a3, yaw + h * w3
    c4, s4 = math.cos(yaw4), math.sin(yaw4)
    a4, w4 = c4 * u_north + s4 * u_east, (c4 * u_east - s4 * u_north) / v4
    return State(
        north + sixth * (v1 * c1 + 2.0 * (v2 * c2 + v3 * c3) + v4 * c4),
        east + sixth * (v1 * s1 + 2.0 * (v2 * s2 + v3 * s3) + v4 * s4),
        yaw + sixth * (w1 + 2.0 * (w2 + w3) + w4),
        v1 + sixth * (a1 + 2.0 * (a2 + a3) + a4),
    )


def _limited_step(state: State, command: Command, bounds: Bounds, h: float) -> State:
    """A Runge-Kutta step with everything in it."""
    north, east, yaw, speed = state
    half = 0.5 * h
    n1, e1, w1, a1 = _rates(yaw, speed, command, bounds)
    n2, e2, w2, a2 = _rates(yaw + half * w1, speed + half * a1, command, bounds)
    n3, e3, w3, a3 = _rates(yaw + half * w2, speed + half * a2, command, bounds)
    n4, e4, w4, a4 = _rates(yaw + h * w3, speed + h * a3, command, bounds)
    sixth = h / 6.0
    speed += sixth * (a1 + 2.0 * (a2 + a3) + a4)
    # A step across a limit overshoots it by less than one step's change; the limit holds at every step's end.
    if speed < bounds[0]:
        speed = bounds[0]
    elif speed > bounds[1]:
        speed = bounds[1]
    return State(
        north + sixth * (n1 + 2.0 * (n2 + n3) + n4),
        east + sixth * (e1 + 2.0 * (e2 + e3) + e4),
        yaw + sixth * (w1 + 2.0 * (w2 + w3) + w4),
        speed,
    )


def _rates(yaw: float, speed: float, command: Command, bounds: Bounds) -> tuple[float, float, float, float]:
    """Rates of (north, east, yaw, speed).

    The acceleration limit shortens the wanted acceleration vector before the linearisation and keeps its direction:
    |u|² = a² + (V ω)², so it bounds the acceleration of the vehicle whichever way it points. The turn rate and then
    the speed limits cut what is left, each on its own.
    """
    speed_min, speed_max, acceleration_max, turn_rate_max = bounds
    u_north, u_east, velocity_north, velocity_east, gain = command
    cosine, sine = math.cos(yaw), math.sin(yaw)
    rate_north, rate_east = speed * cosine, speed * sine
    if gain:
        u_north += gain * (velocity_north - rate_north)
        u_east += gain * (velocity_east - rate_east)
    if u_north * u_north + u_east * u_east > acceleration_max * acceleration_max:
        shorten = acceleration_max / math.hypot(u_north, u_east)
        u_north *= shorten
        u_east *= shorten
    acceleration = cosine * u_north + sine * u_east
    if (speed <= speed_min and acceleration < 0.0) or (speed >= speed_max and acceleration > 0.0):
        acceleration = 0.0
    # A stage may look a little below the least speed; M is never evaluated there, so it cannot meet its singularity.
    turn_rate = (cosine * u_east - sine * u_north) / (speed if speed > speed_min else speed_min)
    if turn_rate > turn_rate_max:
        turn_rate = turn_rate_max
    elif turn_rate < -turn_rate_max:
        turn_rate = -turn_rate_max
    return rate_north, rate_east, turn_rate, acceleration
