"""Datagrams read and sent by kernels, on real sockets."""

import socket
import time  # noqa: TID251 - what is tested here reads the clock
from collections.abc import Generator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.sockets import NO_ADDRESS, Reader, address_of, joined, number_of, stamped, write


@pytest.fixture
def two() -> Generator[tuple[socket.socket, socket.socket]]:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        for own in (one, other):
            stamped(own).bind(("127.0.0.1", 0))
        yield one, other


@given(st.ip_addresses(v=4), st.integers(0, 65535))
def test_every_address_has_a_number_of_its_own(host: object, port: int) -> None:
    number = number_of((str(host), port))
    assert 0 <= number < 1 << 48
    assert address_of(number) == (str(host), port)


def test_what_is_written_is_read_with_its_sender_and_time(two: tuple[socket.socket, socket.socket]) -> None:
    one, other = two
    data = [bytes([k]) * k for k in range(200)]  # the first is empty
    stream, ends = joined(data)
    before_ns = time.monotonic_ns()
    to = np.full(len(data), number_of(other.getsockname()))
    sent_ns, refused, failed = write(
        stream, ends[:-1], ends[1:], np.full(len(data), one.fileno()), to, Reader().buffers
    )
    assert (refused, failed) == (0, 0)
    assert before_ns < sent_ns[0]
    assert (np.diff(sent_ns) > 0).all()
    batch = Reader().read([other.fileno(), one.fileno()])
    assert [found.data for found in batch] == data
    assert {(found.descriptor, found.address) for found in batch} == {(other.fileno(), one.getsockname())}
    assert (batch.table[3] <= batch.read_ns).all()
    assert other.getsockname() not in {found.address for found in batch}


def frames_of(*sizes: int) -> list[bytes]:
    """MAVLink 2 frames as far as their size tells: magic, size of the payload, the rest zero."""
    return [bytes([0xFD, size]) + bytes(10 + size) for size in sizes]


def test_frames_together_share_datagrams_and_are_read_one_by_one(two: tuple[socket.socket, socket.socket]) -> None:
    one, other = two
    signed, version_1 = b"\xfd\x02\x01" + bytes(24), b"\xfe\x03" + bytes(9)
    data = [*frames_of(*range(0, 250, 10)), signed, version_1]
    stream, ends = joined(data)
    to, reader = np.full(len(data), number_of(other.getsockname())), Reader(together=True)
    sent_ns, *_ = write(stream, ends[:-1], ends[1:], np.full(len(data), one.fileno()), to, reader.buffers)
    raw = [other.recv(2048) for _ in range(len(set(sent_ns.tolist())))]
    assert b"".join(raw) == b"".join(data)
    assert len(raw) < 5
    assert max(map(len, raw)) <= 1400
    for each in raw:
        one.sendto(each, other.getsockname())
    assert [found.data for found in reader.read([other.fileno()])] == data


def test_frames_together_go_only_to_one_address(two: tuple[socket.socket, socket.socket]) -> None:
    one, other = two
    data = frames_of(1, 2, 3)
    stream, ends = joined(data)
    to = np.array([number_of(own.getsockname()) for own in (one, other, one)])
    write(stream, ends[:-1], ends[1:], np.full(3, one.fileno()), to, Reader(together=True).buffers)
    assert [one.recv(2048), other.recv(2048), one.recv(2048)] == [data[0], data[1], data[2]]


@pytest.mark.parametrize(("place", "value"), [(0, 0xFC), (0, 0xFE), (1, 15), (1, 255), (2, 1)])
def test_a_frame_with_flipped_bits_hides_no_other(
    two: tuple[socket.socket, socket.socket], place: int, value: int
) -> None:
    one, other = two
    data = frames_of(10, 20, 14, 30, 40)
    data[2] = data[2][:place] + bytes([value]) + data[2][place + 1 :]
    stream, ends = joined(data)
    to, reader = np.full(len(data), number_of(other.getsockname())), Reader(together=True)
    write(stream, ends[:-1], ends[1:], np.full(len(data), one.fileno()), to, reader.buffers)
    assert [found.data for found in reader.read([other.fileno()])] == data


@pytest.mark.parametrize("spoiled", [b"", b"\xfd", b"\xfd\xff\x00", b"noise", b"\xfe\x30" + bytes(8)])
def test_what_is_not_frames_alone_is_read_whole(two: tuple[socket.socket, socket.socket], spoiled: bytes) -> None:
    one, other = two
    data = b"".join(frames_of(5, 6)) + spoiled
    one.sendto(data, other.getsockname())
    one.sendto(spoiled, other.getsockname())
    whole = [data] if spoiled else frames_of(5, 6)
    assert [found.data for found in Reader(together=True).read([other.fileno()])] == [*whole, spoiled]


def test_one_read_takes_a_limited_number_from_each_socket(two: tuple[socket.socket, socket.socket]) -> None:
    one, other = two
    for k in range(20):
        one.sendto(bytes([k]), other.getsockname())
    other.sendto(b"few", one.getsockname())
    reader, both = Reader(16), [one.fileno(), other.fileno()]
    assert [found.data for found in reader.read(both)] == [b"few", *(bytes([k]) for k in range(16))]
    assert [found.data for found in reader.read(both)] == [bytes([k]) for k in range(16, 20)]
    assert reader.read(both).table.shape == (5, 0)


def test_datagrams_beyond_the_readers_room_wait_in_the_socket(two: tuple[socket.socket, socket.socket]) -> None:
    one, other = two
    other.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
    reader, came, count = Reader(), 0, 0
    for k in range(3000):
        one.sendto(k.to_bytes(2, "big") * 500, other.getsockname())
    while batch := [*reader.read([other.fileno()])]:
        assert [found.data[:2] for found in batch] == [k.to_bytes(2, "big") for k in range(came, came + len(batch))]
        came, count = came + len(batch), count + 1
    assert count > 1 or came < 1000  # or the host limits the buffer to a small one
    assert came > 100


def test_closed_ports_are_counted_and_do_not_stop_what_follows(two: tuple[socket.socket, socket.socket]) -> None:
    one, other = two
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        closed = gone.getsockname()
    one.connect(closed)
    stream, ends = joined([b"anyone?", b"to you"])
    descriptors, to = np.array([one.fileno(), other.fileno()]), np.array([NO_ADDRESS, number_of(other.getsockname())])
    counts = [0, 0]
    reader = Reader()
    for _ in range(3):
        _, refused, _ = write(stream, ends[:-1], ends[1:], descriptors, to, reader.buffers)
        counts[0] += refused
        counts[1] += reader.read([one.fileno()]).errors
    assert sum(counts) >= 3
    assert [found.data for found in reader.read([other.fileno()])] == [b"to you"] * 3
    _, _, failed = write(stream, ends[:1], ends[1:2], np.array([10_000]), np.array([NO_ADDRESS]), reader.buffers)
    assert failed == 1
