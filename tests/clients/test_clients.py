"""Optional clients, too large for every installation, fly our vehicles: MAVProxy, and MAVSDK through its server.

`python3 make.py clients` installs them and runs these tests, which are skipped without them.
"""

import asyncio  # noqa: TID251 - the MAVSDK client is asynchronous
import math
import os
import re
import select
import shutil
import subprocess
import sys
import time  # noqa: TID251 - the clients have clocks of their own
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import pytest

from tests.support.fleets.flown_fleet import copters, fleet
from tests.support.processes import PATIENCE_S

HINT = "is not installed: python3 make.py clients"
MAVPROXY = shutil.which("mavproxy.py", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("clients")]


class Console:
    """MAVProxy in a process of its own: takes command lines, and collects the output."""

    def __init__(self, port: int, folder: Path) -> None:
        assert MAVPROXY is not None
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        self.written = ""
        self._process = subprocess.Popen(
            [MAVPROXY, f"--master=udpin:127.0.0.1:{port}", "--target-system=1"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=folder,
            env={**environment, "HOME": str(folder), "PYTHONUNBUFFERED": "1"},
        )

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()

    def say(self, command: str) -> None:
        """Send a command line."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{command}\n".encode())
        self._process.stdin.flush()

    def expect(self, pattern: str, command: str = "", *, repeat_s: float = PATIENCE_S) -> None:
        """Wait for a pattern in new output; until it comes, send a command, if given, every `repeat_s`."""
        begin, end_s, said_s = len(self.written), time.monotonic() + PATIENCE_S, -PATIENCE_S
        assert self._process.stdout is not None
        file_number = self._process.stdout.fileno()
        while not re.search(pattern, self.written[begin:]):
            now_s = time.monotonic()
            assert now_s < end_s, f"no {pattern!r} in {self.written!r}"
            if command and now_s - said_s > repeat_s:
                self.say(command)
                said_s = now_s
            if select.select([file_number], [], [], 0.1)[0]:
                self.written += os.read(file_number, 4096).decode("utf-8", "replace")


@pytest.fixture
def console(tmp_path: Path) -> Generator[Console]:
    with fleet(copters(), tmp_path) as port:
        opened = Console(port, tmp_path)
        yield opened
        opened.close()


@pytest.mark.skipif(MAVPROXY is None, reason=f"MAVProxy {HINT}")
def test_mavproxy_lists_sets_arms_takes_off_and_flies_without_complaint(console: Console) -> None:
    console.expect(r"Received \d+ parameters")
    console.expect(r"GUID_TIMEOUT +3\.0", "param show GUID_TIMEOUT")
    console.say("param set GUID_TIMEOUT 4")
    console.expect(r"GUID_TIMEOUT +4\.0", "param show GUID_TIMEOUT", repeat_s=0.5)
    console.expect(r"HOME_POSITION \{latitude : -3536\d+", "status HOME_POSITION")
    console.expect(r"Mode GUIDED", "mode GUIDED")
    console.expect(r"(?m)^ARMED", "arm throttle")
    console.expect(r"NAV_TAKEOFF: ACCEPTED", "takeoff 5")
    # each command is one set-point in the body frame, and the vehicle faces north
    console.expect(r"vx : (1\.0|0\.9[5-9])", "velocity 1 0 0\nstatus LOCAL_POSITION_NED", repeat_s=0.5)
    console.expect(r"Mode BRAKE", "mode BRAKE")
    for kind, name in (("wp", "waypoints"), ("fence", "fence items"), ("rally", "rally items")):
        console.expect(rf"Requesting 0 {name}", f"{kind} list")
    for complaint in ("breach", "disabled", "Unknown", "no link", "link 1 down", "PreArm", "not healthy", "error"):
        assert complaint not in console.written, console.written


async def first(stream: Any, wanted: Callable[[Any], bool]) -> Any:
    """The first value of a client's stream that is `wanted`."""
    async for value in stream:
        if wanted(value):
            return value
    raise AssertionError


def is_connected(state: Any) -> bool:
    return state.is_connected


def is_up(position: Any) -> bool:
    return position.relative_altitude_m > 1.0


def flies(north_m_s: float, east_m_s: float) -> Callable[[Any], bool]:
    def at_that_velocity(velocity: Any) -> bool:
        return math.dist((velocity.north_m_s, velocity.east_m_s), (north_m_s, east_m_s)) < 0.1

    return at_that_velocity


async def fly(drone: Any, velocity: Any) -> None:
    await drone.connect()
    await first(drone.core.connection_state(), is_connected)
    await first(drone.telemetry.health_all_ok(), bool)
    assert (await drone.param.get_param_int("SYSID_THISMAV")) == 1
    await drone.action.arm()
    await drone.action.takeoff()
    await first(drone.telemetry.position(), is_up)
    await drone.offboard.set_velocity_ned(velocity)
    await drone.offboard.start()
    await first(drone.telemetry.velocity_ned(), flies(2.0, -1.0))
    await drone.action.hold()
    await first(drone.telemetry.velocity_ned(), flies(0.0, 0.0))


def test_the_mavsdk_server_takes_off_and_flies_a_velocity(tmp_path: Path) -> None:
    mavsdk: Any = pytest.importorskip("mavsdk_grpc", reason=f"mavsdk-grpc {HINT}")
    offboard: Any = pytest.importorskip("mavsdk_grpc.offboard")
    whole = copters()
    alone = whole.model_copy(update={"vehicles": whole.vehicles[:1]})  # the server exposes the first that it finds
    with fleet(alone, tmp_path) as port:
        server = Path(mavsdk.__file__).parent / "bin" / "mavsdk_server"
        with subprocess.Popen([server, "-p", str(port), f"udpin://127.0.0.1:{port}"]) as process:  # TCP, and UDP
            drone = mavsdk.System(mavsdk_server_address="127.0.0.1", port=port)
            velocity = offboard.VelocityNedYaw(2.0, -1.0, 0.0, 0.0)
            try:
                asyncio.run(asyncio.wait_for(fly(drone, velocity), 3.0 * PATIENCE_S))
            finally:
                process.kill()
