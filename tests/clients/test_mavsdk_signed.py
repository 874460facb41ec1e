"""MAVSDK and signed vehicles: it cannot sign itself, and flies them only if its bytes are signed for it."""

import socket
import threading  # noqa: TID251 - MAVSDK has threads of its own
import time  # noqa: TID251 - and a clock of its own
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action, ActionError
from mavsdk.plugins.telemetry import Telemetry

from scenarios.signing.keys import make_key, read_key
from scenarios.signing.link import SignedLink
from scenarios.signing.stamps import Stamps
from sim_vehicles.services.mavlink import CRC_EXTRA
from tests.support.fleets.flown_fleet import copters, fleet, until

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("clients")]


def a_client(connection: str) -> Any:
    client = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    client.add_any_connection(connection)
    return client


class SignedBytes:
    """The application's part: signs what MAVSDK sends on a raw connection, and verifies what it receives."""

    def __init__(self, client: Any, port: int, key_file: Path) -> None:
        self.refused: Counter[str] = Counter()
        self.stop = False
        self._client = client
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.1)
        self._lock = threading.Lock()
        self._vehicles: set[tuple[str, int]] = set()
        self._link = SignedLink(
            read_key(key_file),
            link_id=0,
            crc_extra=CRC_EXTRA,
            epoch_ns=time.time_ns() - time.monotonic_ns(),
            stamps=Stamps(),
        )
        client.subscribe_raw_bytes_to_be_sent(self.send)

    def send(self, data: bytes) -> None:
        with self._lock:
            signed = self._link.sign(data, time.monotonic_ns())
            for address in self._vehicles:  # each vehicle takes only what is addressed to it
                self._socket.sendto(signed, address)

    def run(self) -> None:
        while not self.stop:
            try:
                data, address = self._socket.recvfrom(2048)
            except TimeoutError:
                continue
            with self._lock:
                good = self._link.verify(data, time.monotonic_ns(), self.refused)
                self._vehicles |= {address} if good else set()
            if good:
                self._client.pass_received_raw_bytes(good)
        self._socket.close()


def test_mavsdk_commands_signed_vehicles_only_through_a_connection_that_signs(tmp_path: Path) -> None:
    key_file = tmp_path / "key"
    make_key(key_file)
    with fleet(copters(), tmp_path, "--key", str(key_file)) as port:
        plain = a_client(f"udpin://127.0.0.1:{port}")
        until(lambda: plain.system_count() == 5, "five systems")  # it hears them: it checks no signature
        with pytest.raises(ActionError):
            Action(plain.get_systems()[0]).arm()
        plain.destroy()
        client = a_client("raw://")
        signed = SignedBytes(client, port, key_file)
        thread = threading.Thread(target=signed.run)
        thread.start()
        try:
            until(lambda: client.system_count() == 5, "five systems")
            system = client.get_systems()[0]
            told = Telemetry(system)
            until(told.health_all_ok, "healthy")
            assert not told.armed()
            Action(system).arm()
            until(told.armed, "armed")
            assert not signed.refused
        finally:
            signed.stop = True
            thread.join()
            client.destroy()
