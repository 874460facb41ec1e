"""The station's socket: the kernel stamps when datagrams arrive, and the stamps are on the station's clock."""

import socket

import pytest

from gcs.drive.udp import StationSocket, clock_ns
from gcs.link.datagram import Datagram
from tests.support.station_peer import address_at

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("realtime")]


def spin(wait_ns: int) -> None:
    until_ns = clock_ns() + wait_ns
    while clock_ns() < until_ns:
        pass


def test_a_datagrams_stamp_lies_between_sending_and_reading() -> None:
    with StationSocket("127.0.0.1", 0) as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        # Linux begins to stamp some time after the first socket has asked for it; until then reading does.
        for _ in range(1000):
            peer.sendto(b"", link.address)
            spin(2_000_000)
            if any(datagram.queued_ns > 1_000_000 for datagram in link.receive()):
                break
        for wait_ns in (0, 5_000_000):
            sent_ns: list[int] = []
            for number in range(50):
                sent_ns.append(clock_ns())
                peer.sendto(bytes([number]), link.address)
            spin(wait_ns)
            came: list[Datagram] = []
            while len(came) < 50:
                came += link.receive()
            read_ns = clock_ns()
            assert [datagram.data[0] for datagram in came] == list(range(50))
            for before_ns, datagram in zip(sent_ns, came, strict=True):
                # two clocks are compared, to some microseconds
                assert before_ns - 50_000 <= datagram.received_ns <= read_ns
                assert datagram.queued_ns <= read_ns - before_ns + 50_000
            waited_ns = sorted(datagram.queued_ns for datagram in came)
            assert waited_ns[25] >= wait_ns - 50_000  # the kernel may hand single ones over late


def test_a_datagram_waits_for_others_as_long_as_it_may() -> None:
    with StationSocket("127.0.0.1", 0) as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        waited_ns: list[int] = []
        for _ in range(15):
            link.wait(clock_ns())
            begun_ns = clock_ns()
            peer.sendto(b"", link.address)
            link.wait(begun_ns + 200_000_000, 10_000_000)
            waited_ns.append(clock_ns() - begun_ns)
            assert len(link.receive()) == 1
        assert 9_000_000 < sorted(waited_ns)[7] < 30_000_000


def test_senders_are_known_by_their_addresses() -> None:
    with StationSocket("127.0.0.1", 0) as link:
        for number in range(3):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
                peer.bind(("127.0.0.1", 0))
                peer.sendto(bytes([number]), link.address)
                [came] = link.receive()
                assert (came.data, came.address) == (bytes([number]), address_at(*peer.getsockname()))
                sent = link.send([(b"answer", came.address)])
                assert [(one.data, one.address) for one in sent] == [(b"answer", came.address)]
                assert peer.recv(100) == b"answer"
