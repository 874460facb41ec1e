"""Motion of a double integrator: planar kinematics under feedback linearisation on board, with limits.

    X' = V cos ψ,   Y' = V sin ψ,   ψ' = ω,   V' = a                                   (thesis eq. 2.2-2.4)
    (a, ω) = M(ξ) u,   M = [[cos ψ, sin ψ], [-sin ψ / V, cos ψ / V]]                   (thesis eq. 2.6)

u is the commanded acceleration (north, east). While u is constant and no limit binds, the solution is the closed form
of a planar double integrator. Otherwise RK4 integrates the equations with M evaluated in every stage: the linearisation
is continuous, not sampled.

The motion is computed in kernels, as it is needed for every sample and every set-point of every vehicle.
"""

import math
from typing import NamedTuple

from scenarios import schema
from scenarios.hypot import hypot
from scenarios.kernel import Record, kernel
from scenarios.schema import NS_PER_S

LONGEST_STEP_S = 0.02
VELOCITY_GAIN_1_S = 2.0
"""Gain of the velocity feedback for set-points that carry a velocity: a time constant of 0.5 s."""
LARGEST_M_S2 = 20_000.0
"""Acceleration limit where the scenario sets none: reports stay finite, however unstable the loop."""


class State(NamedTuple):
    """Position, course and speed; yaw is clockwise from north and is not wrapped."""

    north_m: float
    east_m: float
    yaw_rad: float
    speed_m_s: float

    def velocity_ne_m_s(self) -> tuple[float, float]:
        """Velocity over ground (north, east)."""
        return self.speed_m_s * math.cos(self.yaw_rad), self.speed_m_s * math.sin(self.yaw_rad)


class Command(NamedTuple):
    """The commanded acceleration u = acceleration + velocity_gain (velocity - own velocity), north and east."""

    acceleration_north_m_s2: float = 0.0
    acceleration_east_m_s2: float = 0.0
    velocity_north_m_s: float = 0.0
    velocity_east_m_s: float = 0.0
    velocity_gain_1_s: float = 0.0


COAST = Command()
"""Constant velocity, wings level."""


class Bounds(NamedTuple):
    """The limits as numbers; an omitted limit of speed or turn rate is infinite."""

    speed_min_m_s: float
    speed_max_m_s: float
    acceleration_max_m_s2: float
    turn_rate_max_rad_s: float


def bounds_of(limits: schema.Limits) -> Bounds:
    """The scenario's limits in the form that the integration needs."""
    return Bounds(
        limits.speed_min_m_s,
        limits.speed_max_m_s or math.inf,
        limits.acceleration_max_m_s2 or LARGEST_M_S2,
        limits.turn_rate_max_rad_s or math.inf,
    )


def state_from(position_ne_m: tuple[float, float], velocity_ne_m_s: tuple[float, float]) -> State:
    """The state of a vehicle at a position with a velocity over ground."""
    (place_north, place_east), (north, east) = position_ne_m, velocity_ne_m_s
    return State(float(place_north), float(place_east), math.atan2(east, north), math.hypot(north, east))


@kernel
def advance(state: State, command: Command, bounds: Bounds, duration_s: float) -> State:
    """The state after `duration_s` with the command held."""
    if _is_free(state[3], command, bounds, duration_s):
        return _free_flight(state, command[0], command[1], duration_s)
    steps = max(1, math.ceil(duration_s / LONGEST_STEP_S))
    step_s = duration_s / steps
    for _ in range(steps):
        if _is_free(state[3], command, bounds, step_s):
            state = _free_flight(state, command[0], command[1], step_s)
        else:
            state = _limited_step(state, command, bounds, step_s)
    return state


@kernel
def advance_to(vehicle: Record, time_ns: int) -> None:
    """Move a vehicle to a time; it stays where it is until it flies. An earlier time changes nothing."""
    if time_ns <= vehicle.state_ns:
        return
    if vehicle.flying:
        duration_s = (time_ns - vehicle.state_ns) / NS_PER_S
        set_state(vehicle, advance(state_of(vehicle), command_of(vehicle), _bounds_of(vehicle), duration_s))
    vehicle.state_ns = time_ns


@kernel
def state_of(vehicle: Record) -> State:
    own = vehicle.state
    return State(own[0], own[1], own[2], own[3])


@kernel
def set_state(vehicle: Record, state: State) -> None:
    own = vehicle.state
    own[0], own[1], own[2], own[3] = state


@kernel
def command_of(vehicle: Record) -> Command:
    own = vehicle.command
    return Command(own[0], own[1], own[2], own[3], own[4])


@kernel
def set_command(vehicle: Record, command: Command) -> None:
    own = vehicle.command
    own[0], own[1], own[2], own[3], own[4] = command


@kernel
def _bounds_of(vehicle: Record) -> Bounds:
    own = vehicle.bounds
    return Bounds(own[0], own[1], own[2], own[3])


@kernel
def shifted(state: State, north_m: float, east_m: float, north_m_s: float, east_m_s: float) -> State:
    """The state with these changes of position and velocity; the course turns by less than half a circle."""
    cosine, sine = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    along, across = state.speed_m_s + cosine * north_m_s + sine * east_m_s, cosine * east_m_s - sine * north_m_s
    turn_rad, speed_m_s = math.atan2(across, along), hypot(along, across)
    return State(state.north_m + north_m, state.east_m + east_m, state.yaw_rad + turn_rad, speed_m_s)


@kernel
def move_under_push(vehicle: Record, piece: tuple[float, float, float, float, float]) -> None:
    """Move a flying vehicle over an interval of constant push, a `Piece` of `air`."""
    t, half_north, half_east, north, east = piece
    state = shifted(state_of(vehicle), 0.0, 0.0, half_north, half_east)
    state = advance(state, command_of(vehicle), _bounds_of(vehicle), t)
    set_state(vehicle, shifted(state, north, east, half_north, half_east))


@kernel
def _is_free(speed: float, command: Command, bounds: Bounds, t: float) -> bool:
    """Whether u is constant and no limit can bind within t seconds."""
    if command[4] != 0.0:
        return False
    speed_min, speed_max, acceleration_max, turn_rate_max = bounds
    wanted = hypot(command[0], command[1])
    slowest = speed - wanted * t
    return (
        slowest > speed_min
        and wanted <= acceleration_max
        and speed + wanted * t < speed_max
        and wanted <= turn_rate_max * slowest
    )


@kernel
def _free_flight(state: State, u_north: float, u_east: float, t: float) -> State:
    """The solution without limits: the velocity changes by u t, resolved along and across the initial course.

    With constant u the course turns by less than half a circle, so the yaw needs no wrapping.
    """
    north, east, yaw, speed = state
    cosine, sine = math.cos(yaw), math.sin(yaw)
    along, across = speed + (cosine * u_north + sine * u_east) * t, (cosine * u_east - sine * u_north) * t
    half = 0.5 * t
    return State(
        north + t * (speed * cosine + half * u_north),
        east + t * (speed * sine + half * u_east),
        yaw + math.atan2(across, along),
        hypot(along, across),
    )


def limited(state: State, command: Command, bounds: Bounds) -> tuple[float, float]:
    """The acceleration (north, east) that a command causes; exactly the commanded one if no limit binds."""
    _, _, yaw, speed = state
    _, _, turn_rate, along = rates(yaw, speed, command, bounds)
    cosine, sine, across = math.cos(yaw), math.sin(yaw), turn_rate * max(speed, bounds[0])
    found = cosine * along - sine * across, sine * along + cosine * across
    return command[:2] if math.dist(found, command[:2]) <= 1e-9 * (1.0 + math.hypot(*found)) else found


@kernel
def _limited_step(state: State, command: Command, bounds: Bounds, h: float) -> State:
    north, east, yaw, speed = state
    half = 0.5 * h
    n1, e1, w1, a1 = rates(yaw, speed, command, bounds)
    n2, e2, w2, a2 = rates(yaw + half * w1, speed + half * a1, command, bounds)
    n3, e3, w3, a3 = rates(yaw + half * w2, speed + half * a2, command, bounds)
    n4, e4, w4, a4 = rates(yaw + h * w3, speed + h * a3, command, bounds)
    sixth = h / 6.0
    speed += sixth * (a1 + 2.0 * (a2 + a3) + a4)
    # A step across a limit overshoots it by less than one step's change; the speed is clipped at the end of the step.
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


@kernel
def rates(yaw: float, speed: float, command: Command, bounds: Bounds) -> tuple[float, float, float, float]:
    """Rates of (north, east, yaw, speed).

    The acceleration limit shortens u before the linearisation and keeps its direction: |u|² = a² + (V ω)², so it bounds
    the acceleration of the vehicle in every direction. The speed limits then cut a, and the turn-rate limit cuts ω.
    """
    speed_min, speed_max, acceleration_max, turn_rate_max = bounds
    u_north, u_east, velocity_north, velocity_east, gain = command
    cosine, sine = math.cos(yaw), math.sin(yaw)
    rate_north, rate_east = speed * cosine, speed * sine
    if gain:
        u_north += gain * (velocity_north - rate_north)
        u_east += gain * (velocity_east - rate_east)
    if u_north * u_north + u_east * u_east > acceleration_max * acceleration_max:
        shorten = acceleration_max / hypot(u_north, u_east)
        u_north *= shorten
        u_east *= shorten
    acceleration = cosine * u_north + sine * u_east
    if (speed <= speed_min and acceleration < 0.0) or (speed >= speed_max and acceleration > 0.0):
        acceleration = 0.0
    # A stage may fall slightly below the minimum speed; M is not evaluated there, so it stays clear of its singularity.
    turn_rate = (cosine * u_east - sine * u_north) / (speed if speed > speed_min else speed_min)
    if turn_rate > turn_rate_max:
        turn_rate = turn_rate_max
    elif turn_rate < -turn_rate_max:
        turn_rate = -turn_rate_max
    return rate_north, rate_east, turn_rate, acceleration
