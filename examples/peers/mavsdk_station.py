"""A plain ground station on MAVSDK, started with the arguments of `plain`.

MAVSDK sends a set-point whenever one is set, here in each tick, and otherwise repeats the last at 20 Hz.
"""

import atexit
import time  # noqa: TID251 - MAVSDK has threads and a clock of its own
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
from plain import Law, fly

from scenarios.schema import NS_PER_S

_POLL_S = 0.05


def _ignore(*_: object) -> None: ...


class _Station:
    def __init__(self, law: Law, port: int) -> None:
        # imported by name, without types: it is installed only where it is compared with
        mavsdk: Any = import_module("mavsdk")
        plugins: dict[str, Any] = {n: import_module(f"mavsdk.plugins.{n}") for n in ("offboard", "telemetry", "action")}
        self._law, self._acceleration = law, plugins["offboard"].AccelerationNed
        self._mavsdk = mavsdk.Mavsdk(
            mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
        )
        atexit.register(self._mavsdk.destroy)
        self._mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        while self._mavsdk.system_count() < len(law.system_ids):
            time.sleep(_POLL_S)
        systems = {system.get_system_id(): system for system in self._mavsdk.get_systems()}
        ordered = [systems[system_id] for system_id in law.system_ids]
        self._telemetry = [plugins["telemetry"].Telemetry(system) for system in ordered]
        self._offboard = [plugins["offboard"].Offboard(system) for system in ordered]
        self._action = [plugins["action"].Action(system) for system in ordered]

    def start(self, telemetry_hz: float) -> None:
        def keep(state: Any, row: int) -> None:
            at, moves = state.position, state.velocity
            self._law.states[row] = at.north_m, at.east_m, moves.north_m_s, moves.east_m_s

        for row, (telemetry, offboard) in enumerate(zip(self._telemetry, self._offboard, strict=True)):
            telemetry.subscribe_position_velocity_ned(keep, row)
            telemetry.set_rate_position_velocity_ned(telemetry_hz)
            offboard.set_acceleration_ned(self._acceleration(0.0, 0.0, 0.0))
            offboard.start()
        for action in self._action:  # last, and all together: an armed vehicle is launched by its next set-point
            action.arm_async(_ignore)
        while not (all(own.armed() for own in self._telemetry) and np.isfinite(self._law.states).all()):
            time.sleep(_POLL_S)

    def wait(self, until_ns: int) -> None:
        """Sleep until an instant; MAVSDK's threads take the telemetry."""
        time.sleep(max(0, until_ns - time.monotonic_ns()) / NS_PER_S)

    def send(self, commands: Sequence[Sequence[float]]) -> None:
        for offboard, (north_m_s2, east_m_s2) in zip(self._offboard, commands, strict=True):
            offboard.set_acceleration_ned(self._acceleration(north_m_s2, east_m_s2, 0.0))


if __name__ == "__main__":
    fly(_Station)
