"""A ground station's side of MAVLink for the tests of the vehicles: plain pymavlink, and nothing of theirs."""

from collections.abc import Callable
from typing import Any, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as dialect

from scenarios.keys.link import Link, Links
from scenarios.schema import Clocks, Limits, NominalVelocity, Safety, Scenario, Vehicle
from sim_vehicles.vehicles.double_integrator import DoubleIntegrator
from sim_vehicles.vehicles.shell import Craft, Radio, Shell

SECOND = 1_000_000_000
MS = 1_000_000
START = 5 * SECOND

Flown = TypeVar("Flown", bound=Craft)
_MAV = dialect.MAVLink(None, srcSystem=255, srcComponent=190)


def scenario(
    count: int = 1,
    *,
    seed: int = 1,
    up_s: float = 0.0,
    down_s: float = 0.0,
    offset_max_s: float = 100.0,
    drift_max_ppm: float = 20.0,
    limits: Limits | None = None,
) -> Scenario:
    """A chain of vehicles with system ids from 1, the second 50 m behind the first and so on, at (40, 9) m/s."""
    vehicles = tuple(
        Vehicle(
            system_id=k,
            follows=k - 1 if k > 1 else None,
            offset_ne_m=(-50.0, 0.0) if k > 1 else None,
            position_ne_m=(-50.0 * (k - 1), 10.0),
            velocity_ne_m_s=(40.0, 9.0),
        )
        for k in range(1, count + 1)
    )
    return Scenario(
        name="test",
        seed=seed,
        duration_s=60.0,
        altitude_m=100.0,
        vehicles=vehicles,
        nominal_velocity=(NominalVelocity(from_s=0.0, velocity_ne_m_s=(40.0, 9.0)),),
        links=Links(up=Link(delay_s=up_s), down=Link(delay_s=down_s)),
        clocks=Clocks(offset_max_s=offset_max_s, drift_max_ppm=drift_max_ppm),
        safety=Safety(setpoint_timeout_s=1.0, heartbeat_timeout_s=3.0),
        limits=limits or Limits(),
    )


def a_vehicle(**settings: Any) -> Shell[DoubleIntegrator]:
    """The first vehicle of such a scenario, on the launcher at START."""
    return shell_of(scenario(**settings), DoubleIntegrator)


def shell_of(flown: Scenario, craft: Callable[[Scenario, Vehicle, Radio], Flown], k: int = 0) -> Shell[Flown]:
    """The vehicle in place `k` of a scenario, with such a craft, at START."""
    radio = Radio(flown, flown.vehicles[k], START)
    return Shell(flown, radio, craft(flown, flown.vehicles[k], radio))


def pack(message: dialect.MAVLink_message) -> bytes:
    """A MAVLink 2 frame of the station."""
    frame = message.pack(_MAV)
    _MAV.seq = (_MAV.seq + 1) % 256
    return frame


def parse(datagram: bytes) -> Any:
    """The one message in a datagram; anything else raises."""
    messages = dialect.MAVLink(None).parse_buffer(datagram) or []
    assert len(messages) == 1
    return messages[0]


def parse_all(sent: list[tuple[bytes, int]], name: str = "") -> list[tuple[Any, int]]:
    """What a vehicle sent as (message, instant), of one type if named."""
    messages = [(parse(data), time_ns) for data, time_ns in sent]
    return [(m, t) for m, t in messages if not name or m.get_type() == name]


def command(number: int, *parameters: float, system: int = 1, component: int = 1) -> bytes:
    """COMMAND_LONG."""
    padded = (*parameters, *(0.0,) * (7 - len(parameters)))
    return pack(dialect.MAVLink_command_long_message(system, component, number, 0, *padded))


def arm(system: int = 1) -> bytes:
    return command(400, 1, system=system)


def mode(custom: int, system: int = 1) -> bytes:
    return command(176, 1, custom, system=system)


def guided(system: int = 1) -> bytes:
    return mode(4, system)


def heartbeat(vehicle_type: int = dialect.MAV_TYPE_GCS) -> bytes:
    return pack(dialect.MAVLink_heartbeat_message(vehicle_type, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3))


def setpoint(
    north: float = 0.0,
    east: float = 0.0,
    *,
    velocity: tuple[float, float] = (0.0, 0.0),
    mask: int = 0x0C3F,
    frame: int = 1,
    system: int = 1,
    component: int = 1,
    time_boot_ms: int = 0,
) -> bytes:
    """SET_POSITION_TARGET_LOCAL_NED."""
    return pack(
        dialect.MAVLink_set_position_target_local_ned_message(
            time_boot_ms, system, component, frame, mask, 0, 0, 0, *velocity, 0, north, east, 0, 0, 0
        )
    )


def take_off(vehicle: Shell[DoubleIntegrator], time_ns: int = START) -> None:
    """Arm, GUIDED, and a first set-point that wants no acceleration, all at one instant."""
    system = vehicle.system_id
    vehicle.step([(frame, time_ns) for frame in (arm(system), guided(system), setpoint(system=system))], time_ns)
    assert vehicle.craft.flight.flying
