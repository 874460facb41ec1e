"""A plain ground station: pymavlink's dialect and one UDP socket, started with the arguments of `plain`.

It does not use pymavlink's own UDP connection, which would send every set-point to every vehicle.
"""

import select
import socket
import time  # noqa: TID251 - a station of its own, with its own clock
from collections.abc import Sequence
from typing import Any

import numpy as np
from plain import Law, fly
from pymavlink.dialects.v20 import ardupilotmega as dialect

from scenarios.schema import NS_PER_S

_GUIDED = 4
_STATION = 255, 190
_ACCELERATION = 0x0C3F
"""type_mask: all but the acceleration is ignored."""


class _Vehicle:
    """What is known of one vehicle, and the parser and packer of its link."""

    def __init__(self, row: int) -> None:
        self.row = row
        self.link: Any = dialect.MAVLink(None, *_STATION)
        self.address: tuple[str, int] | None = None
        self.ready = False


class _Station:
    def __init__(self, law: Law, port: int) -> None:
        self._law = law
        self.vehicles = {system_id: _Vehicle(row) for row, system_id in enumerate(law.system_ids)}
        self._parser: Any = dialect.MAVLink(None)
        self._heartbeat_ns = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._socket.bind(("127.0.0.1", port))

    def wait(self, until_ns: int) -> None:
        """Take what arrives until an instant, and send a heartbeat to all every second."""
        while True:
            left_s = max(0, until_ns - time.monotonic_ns()) / NS_PER_S
            if not select.select([self._socket], [], [], left_s)[0]:
                break
            self._take(*self._socket.recvfrom(2048))
        if time.monotonic_ns() - self._heartbeat_ns >= NS_PER_S:
            self._heartbeat_ns = time.monotonic_ns()
            alive = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
            for system_id in self.vehicles:
                self._send(system_id, alive)

    def _take(self, data: bytes, address: tuple[str, int]) -> None:
        message = self._parser.parse_char(data)
        vehicle = self.vehicles[message.get_srcSystem()]
        kind = message.get_type()
        if kind == "LOCAL_POSITION_NED":
            self._law.states[vehicle.row] = message.x, message.y, message.vx, message.vy
        elif kind == "HEARTBEAT":
            armed = message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
            vehicle.address, vehicle.ready = address, message.custom_mode == _GUIDED and bool(armed)

    def _send(self, system_id: int, message: Any) -> None:
        vehicle = self.vehicles[system_id]
        if vehicle.address is not None:
            self._socket.sendto(message.pack(vehicle.link), vehicle.address)
            vehicle.link.seq = (vehicle.link.seq + 1) % 256

    def start(self, telemetry_hz: float) -> None:
        wanted = (
            (dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 1e6 / telemetry_hz),
            (dialect.MAV_CMD_DO_SET_MODE, 1, _GUIDED),
            (dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1, 0),
        )
        while not (all(own.ready for own in self.vehicles.values()) and np.isfinite(self._law.states).all()):
            for system_id in self.vehicles:
                for number, first, second in wanted:
                    self._send(
                        system_id,
                        dialect.MAVLink_command_long_message(system_id, 1, number, 0, first, second, 0, 0, 0, 0, 0),
                    )
            self.wait(time.monotonic_ns() + NS_PER_S // 2)

    def send(self, commands: Sequence[Sequence[float]]) -> None:
        now_ms = time.monotonic_ns() // 1_000_000 & 0xFFFFFFFF
        for system_id, (north_m_s2, east_m_s2) in zip(self.vehicles, commands, strict=True):
            head = now_ms, system_id, 1, dialect.MAV_FRAME_LOCAL_NED, _ACCELERATION
            fields = 0, 0, 0, 0, 0, 0, north_m_s2, east_m_s2, 0, 0, 0
            self._send(system_id, dialect.MAVLink_set_position_target_local_ned_message(*head, *fields))


if __name__ == "__main__":
    fly(_Station)
