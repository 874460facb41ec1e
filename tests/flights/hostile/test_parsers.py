"""Hostile bytes at every parser of sockets and files: nothing is raised, and what is no frame is counted.

Most of the bytes are MAVLink's magics, flags and lengths, so that what begins as a frame ends at every place it can.
"""

from collections import Counter
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gcs.link import mavlink
from gcs.watch.tlog import parse_tlog
from scenarios.signing.keys import Key
from scenarios.signing.link import SignedLink
from scenarios.signing.stamps import Stamps
from sim_vehicles.links import relay
from sim_vehicles.services import mavlink as vehicles_mavlink
from sim_vehicles.services.hot import new_place

KEY = Key(bytes(range(32)))
HEARTBEAT_2 = mavlink.encode(mavlink.HEARTBEAT, mavlink.heartbeat(), sequence=7)
HEARTBEAT_1 = vehicles_mavlink.in_version_1(
    vehicles_mavlink.Encoder(new_place()).heartbeat(4, armed=False, flying=True, critical=False)
)
"""Shorter than most frames. Its checksum is right, so that parsers go on to what follows it."""
SIGNED = SignedLink(KEY, link_id=0, crc_extra=mavlink.CRC_EXTRA, epoch_ns=0, stamps=Stamps()).sign(HEARTBEAT_2, 0)
FRAMES = (HEARTBEAT_1, HEARTBEAT_2, SIGNED)
PIECES = st.one_of(
    st.sampled_from((b"\xfd", b"\xfe", b"\xfd\x00", b"\xfe\x00", b"\xfd\xff\x01", b"\x00", b"\x01", b"\xff")),
    st.sampled_from(FRAMES),
    st.sampled_from([frame[:end] for frame in FRAMES for end in range(len(frame))]),
    st.binary(max_size=30),
)
HOSTILE = st.lists(PIECES, max_size=12).map(b"".join)


def verified(data: bytes) -> None:
    link = SignedLink(KEY, link_id=0, crc_extra=mavlink.CRC_EXTRA, epoch_ns=0, stamps=Stamps())
    link.verify(data, 0, Counter())


PARSERS: dict[str, Callable[[bytes], object]] = {
    "station": lambda data: mavlink.decode(data, Counter()),
    "station, MAVLink 1": lambda data: mavlink.decode_1(data, Counter()),
    "monitor and mirror": lambda data: mavlink.decode_either(data, Counter()),
    "end of a frame anywhere": lambda data: [mavlink.frame_end(data, at) for at in range(len(data) + 2)],
    "telemetry log": lambda data: (parse_tlog(data), parse_tlog(bytes(8) + data)),
    "vehicle": lambda data: vehicles_mavlink.read_datagram(data, Counter()),
    "vehicle's link": vehicles_mavlink.message_id,
    "links-only, whose": relay.sender,
    "links-only, keys": relay.holds_key,
    "signed link": verified,
}


@pytest.mark.parametrize("parser", PARSERS.values(), ids=PARSERS)
@given(data=HOSTILE)
def test_no_bytes_make_a_parser_raise(parser: Callable[[bytes], object], data: bytes) -> None:
    parser(data)


@pytest.mark.parametrize("parser", PARSERS.values(), ids=PARSERS)
@pytest.mark.parametrize("before", [b"", *FRAMES])
def test_a_frame_may_end_after_any_of_its_bytes(parser: Callable[[bytes], object], before: bytes) -> None:
    for frame in FRAMES:
        for end in range(len(frame) + 1):
            parser(before + frame[:end])


@pytest.mark.parametrize("decode", [mavlink.decode_1, mavlink.decode_either])
@pytest.mark.parametrize("before", [b"", HEARTBEAT_1])
def test_a_lone_magic_of_mavlink_1_is_counted(
    decode: Callable[[bytes, Counter[str]], list[mavlink.Frame]], before: bytes
) -> None:
    refused: Counter[str] = Counter()
    assert len(decode(before + b"\xfe", refused)) == bool(before)
    assert refused == {"truncated": 1}


@given(data=HOSTILE)
def test_what_is_no_frame_is_counted(data: bytes) -> None:
    for decode in (mavlink.decode, mavlink.decode_1, mavlink.decode_either):
        refused: Counter[str] = Counter()
        frames = decode(data, refused)
        assert sum(len(frame.data) for frame in frames) == len(data) or refused
