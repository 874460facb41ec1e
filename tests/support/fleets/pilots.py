"""A pilot who changes the mode of one of three copters, and what the station tells that vehicle from then on."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from gcs.drive.lockstep import START_NS, Sent, fly_lockstep
from gcs.station.station import Station
from scenarios.schema import Scenario
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.vehicles.copter import Copter
from tests.support.fleets.flown_copters import TRUTH, plan_for, three
from tests.support.sim_client import SECOND, command, parse

LOITER, RTL, POSCTL = 5, 6, 3 << 16
PILOTS_MODE = {"ardupilot": LOITER, "px4": POSCTL}
COMMANDS = {"COMMAND_LONG", "COMMAND_INT", "SET_MODE"}
SET_POINT = "SET_POSITION_TARGET_LOCAL_NED"
SET_MESSAGE_INTERVAL = 511


@dataclass
class PilotsVehicle:
    """A fleet with a pilot who changes the mode of vehicle 3; notes what the station tells it from then on."""

    fleet: Fleet
    flavour: str
    modes: dict[float, int]
    """Mode by time since the start in s."""
    change: Callable[[bytes, int], list[tuple[bytes, int]]] = lambda data, now_ns: [(data, now_ns)]
    """What becomes of a datagram that the vehicle sends."""
    told: list[Any] = field(default_factory=list[Any])
    """MAVLink messages."""
    reached_ns: int = 0
    """When the pilot's first mode must have reached the station; 0 before."""

    @property
    def copter(self) -> Copter:
        craft = self.fleet.vehicle(3).craft
        assert isinstance(craft, Copter)
        return craft

    def step(self, received: Sent, now_ns: int) -> Sent:
        for at_s in [at_s for at_s in self.modes if START_NS + at_s * SECOND <= now_ns]:
            self.fleet.vehicle(3).step([(pilots_switch(self.flavour, self.modes.pop(at_s)), now_ns)], now_ns)
            self.reached_ns = self.reached_ns or now_ns + 3 * SECOND // 2
        if 0 < self.reached_ns < now_ns:
            self.told += [parse(data) for system_id, data, _ in received if system_id == 3]
        sent: list[tuple[int, bytes, int]] = []
        for system_id, data, time_ns in self.fleet.step(received, now_ns):
            kept = self.change(data, time_ns) if system_id == 3 else [(data, time_ns)]
            sent += [(system_id, each, at_ns) for each, at_ns in kept]
        return sent

    @property
    def commanded(self) -> list[str]:
        """Commands that the station should not send: all but rates, and set-points that only keep OFFBOARD open."""
        found = [
            str(message)
            for message in self.told
            if message.get_type() in COMMANDS and getattr(message, "command", 0) != SET_MESSAGE_INTERVAL
        ]
        hovers = [message for message in self.told if message.get_type() == SET_POINT]
        if self.flavour == "px4":  # its pilot can select OFFBOARD only while set-points arrive
            hovers = [m for m in hovers if (m.vx, m.vy, m.afx, m.afy) != (0.0, 0.0, 0.0, 0.0)]
        return found + [str(message) for message in hovers]


def pilots_switch(flavour: str, mode: int) -> bytes:
    """The mode command that has the effect of a switch on the remote control, which needs no link."""
    packed = (mode >> 16 & 0xFF, mode >> 24) if flavour == "px4" else (mode, 0)
    return command(176, 1, *packed, system=3)


def flown(flavour: str, **changes: Any) -> Scenario:
    """Three copters that fly from about 13 s on, for 20 s."""
    return three(flavour=flavour, duration_s=20.0, **changes).model_copy(update={"response": TRUTH})


@cache
def flight_s(flavour: str) -> float:
    """When the formation flight begins, after the start."""
    station = Station(plan_for(flown(flavour)), start_ns=START_NS)
    for tick in fly_lockstep(station.plan, station=station, vehicles=Fleet(flown(flavour), START_NS)):
        if tick["time_s"][0] >= 0.0:
            return (int(tick["due_ns"][0]) - START_NS) / SECOND
    raise AssertionError("it never began")
