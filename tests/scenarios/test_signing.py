"""What a signed link refuses, with real bytes. The frames are pymavlink's, a second implementation of signing."""

import hashlib
from collections import Counter
from typing import Any

import pytest
from fastcrc.crc16 import mcrf4xx
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.link import mavlink
from scenarios.signing.keys import Key
from scenarios.signing.link import LARGEST, MINUTE, REMEMBERED, SignedLink
from scenarios.signing.stamps import Stamps
from sim_vehicles.services.mavlink import CRC_EXTRA
from tests.support.signed_peer import EPOCH_NS, KEY, NOW, NOW_NS, OTHER_KEY, a_sender, position, stamp


def a_link(*, stamps: Stamps | None = None, key: bytes = KEY, owner: int = 0) -> SignedLink:
    return SignedLink(
        Key(key),
        link_id=0,
        crc_extra=CRC_EXTRA,
        epoch_ns=EPOCH_NS,
        stamps=stamps or Stamps(),
        owner=owner,
    )


def verdict(link: SignedLink, frame: bytes, now_ns: int = NOW_NS) -> str:
    """Why a frame is refused; "" if it is accepted."""
    refused: Counter[str] = Counter()
    good = link.verify(frame, now_ns, refused)
    assert refused.total() == (0 if good else 1)
    return next(iter(refused), "")


def test_a_verified_frame_equals_pymavlinks_unsigned_frame() -> None:
    refused: Counter[str] = Counter()
    good = a_link().verify(position(a_sender()), NOW_NS, refused)
    assert good == position(a_sender(key=None))
    assert not refused


def test_a_genuine_frames_wrong_checksum_stays_wrong() -> None:
    """As from a sender that defines the message otherwise: the definition is part of the checksum."""
    sender = a_sender()
    frame = position(sender)
    extra = bytes([mavlink.CRC_EXTRA[32][0] ^ 1])
    signed = frame[:34] + mcrf4xx(frame[1:34] + extra).to_bytes(2, "little") + frame[36:43]
    signed += hashlib.sha256(KEY + signed).digest()[:6]
    refused: Counter[str] = Counter()
    good = a_link().verify(signed, NOW_NS, refused)
    assert mavlink.decode(good, refused) == []
    assert refused == {"bad checksum": 1}


def test_pymavlink_accepts_a_frame_that_is_signed_here() -> None:
    link, receiver = a_link(), a_sender(system=255)
    for k in range(3):
        frame = link.sign(position(a_sender(key=None), north_m=k), NOW_NS)
        (message,) = receiver.parse_buffer(frame)
        assert (message.get_type(), message.x, message.get_signed()) == ("LOCAL_POSITION_NED", k, True)
    assert (receiver.signing.goodsig_count, receiver.signing.timestamp) == (3, NOW + 2)


def test_sent_timestamps_always_increase_and_follow_those_heard() -> None:
    link = a_link()
    plain = position(a_sender(key=None))
    sent = [link.sign(plain, now_ns) for now_ns in (NOW_NS, NOW_NS, NOW_NS - 10**9, NOW_NS + 10**9)]
    assert [stamp(frame) for frame in sent] == [NOW, NOW + 1, NOW + 2, NOW + 100_000]
    assert verdict(link, position(a_sender(timestamp=NOW + 5_000_000))) == ""
    assert stamp(link.sign(plain, NOW_NS)) == NOW + 5_000_001
    assert verdict(link, position(a_sender(timestamp=LARGEST))) == ""
    assert stamp(link.sign(plain, NOW_NS)) == LARGEST  # a sender with our key and a broken clock does not crash us


def unsigned(frame: bytes) -> bytes:
    return position(a_sender(key=None))


def in_version_1(frame: bytes) -> bytes:
    message = dialect.MAVLink_local_position_ned_message(7, 1.5, 2.0, -3.0, 4.0, 5.0, 0.0)
    return message.pack(a_sender(key=None), force_mavlink1=True)


def with_another_key(frame: bytes) -> bytes:
    return position(a_sender(key=OTHER_KEY))


def with_bits_flipped(frame: bytes) -> bytes:
    return frame[:15] + bytes([frame[15] ^ 0x40]) + frame[16:]


def with_an_unknown_flag(frame: bytes) -> bytes:
    return frame[:2] + b"\x03" + frame[3:]


def of_no_message(frame: bytes) -> bytes:
    return frame[:7] + b"\xff\xff\xff" + frame[10:]


def a_key(frame: bytes) -> bytes:
    return dialect.MAVLink_setup_signing_message(1, 1, list(OTHER_KEY), 0).pack(a_sender())


def without_its_end(frame: bytes) -> bytes:
    return frame[:-1]


def the_first_bytes(frame: bytes) -> bytes:
    return frame[:11]


def other_text(frame: bytes) -> bytes:
    return b"hello"


def of_two_minutes_ago(frame: bytes) -> bytes:
    return position(a_sender(timestamp=NOW - 2 * MINUTE))


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        (unsigned, "unsigned"),
        (in_version_1, "MAVLink 1"),
        (with_another_key, "wrong signature"),
        (with_bits_flipped, "bad checksum"),
        (with_an_unknown_flag, "unknown flags"),
        (of_no_message, "unknown message"),
        (a_key, "SETUP_SIGNING"),
        (without_its_end, "truncated"),
        (the_first_bytes, "truncated"),
        (other_text, "not MAVLink"),
        (of_two_minutes_ago, "too old"),
    ],
)
def test_refused_frames_are_counted_by_reason_and_block_no_others(made: Any, reason: str) -> None:
    stamps = Stamps()
    link = a_link(stamps=stamps)
    good, kept = position(a_sender()), stamps.known.copy()
    assert verdict(link, made(good)) == reason
    assert stamps.known == kept
    assert verdict(link, good) == ""


def test_a_refused_frame_does_not_hide_the_next_one() -> None:
    sender = a_sender()
    frames = [position(sender, k) for k in range(3)]
    refused: Counter[str] = Counter()
    good = a_link().verify(frames[0] + unsigned(b"") + with_another_key(b"") + frames[2], NOW_NS, refused)
    plain = a_sender(key=None)
    assert good == b"".join(frame for k, frame in enumerate(position(plain, k) for k in range(3)) if k != 1)
    assert refused == {"unsigned": 1, "wrong signature": 1}


def test_first_contact_may_be_a_minute_behind_and_no_more() -> None:
    assert verdict(a_link(), position(a_sender(timestamp=NOW - MINUTE))) == ""
    assert verdict(a_link(), position(a_sender(timestamp=NOW - MINUTE - 1))) == "too old"
    known = a_link()
    assert verdict(known, position(a_sender(timestamp=NOW - MINUTE))) == ""
    later_ns = NOW_NS + 120 * 10**9  # a system without a clock counts only its frames: it may fall behind
    assert verdict(known, position(a_sender(timestamp=NOW - MINUTE + 1)), later_ns) == ""


def test_replayed_and_overtaken_frames_are_both_refused_and_told_apart() -> None:
    link, sender = a_link(), a_sender()
    frames = [position(sender) for _ in range(6)]
    order = (0, 2, 1, 1, 2, 0, 5, 3, 4, 3)
    reasons = [verdict(link, frames[k]) for k in order]
    over, again = "overtaken", "replayed"
    assert reasons == ["", "", over, again, again, again, "", over, over, again]


def test_an_old_frame_does_not_count_as_overtaken() -> None:
    link, sender = a_link(), a_sender()
    never_sent, *frames = [position(sender) for _ in range(3 * REMEMBERED)]
    assert {verdict(link, frame) for frame in frames} == {""}
    assert verdict(link, never_sent) == "replayed"


def test_timestamps_are_per_system_component_and_link_id() -> None:
    link = a_link()
    ahead = position(a_sender(timestamp=NOW + 1000))
    assert verdict(link, ahead) == ""
    assert verdict(link, position(a_sender(timestamp=NOW, link_id=1))) == ""
    assert verdict(link, position(a_sender(timestamp=NOW, system=2))) == ""
    camera = a_sender(timestamp=NOW)
    camera.srcComponent = 100
    assert verdict(link, position(camera)) == ""
    assert verdict(link, ahead) == "replayed"
    assert verdict(link, position(a_sender(timestamp=NOW))) == "overtaken"


def test_two_owners_share_one_memory_without_mixing_their_timestamps() -> None:
    stamps = Stamps()
    one, two = a_link(stamps=stamps, owner=1), a_link(stamps=stamps, owner=2)
    frame = position(a_sender(system=255))
    assert [verdict(one, frame), verdict(two, frame), verdict(one, frame)] == ["", "", "replayed"]


def test_a_forged_future_frame_silences_pymavlink_not_us() -> None:
    genuine, forger = a_sender(), a_sender(key=OTHER_KEY, timestamp=NOW + 10**10)
    ours, theirs = a_link(), a_sender(system=255)
    assert verdict(ours, position(genuine)) == ""
    forged = position(forger)
    assert verdict(ours, forged) == "wrong signature"
    theirs.parse_buffer(forged)
    after = [position(genuine) for _ in range(10)]
    assert [verdict(ours, frame) for frame in after] == [""] * 10
    heard_by_pymavlink = [theirs.parse_buffer(frame)[0].get_type() for frame in after]
    assert heard_by_pymavlink == ["BAD_DATA"] * 10  # pymavlink stores a timestamp before it checks the signature


def test_after_a_restart_what_was_heard_before_it_is_refused() -> None:
    memory = Stamps()
    before, sender = a_link(stamps=memory), a_sender()
    frames = [position(sender) for _ in range(4)]
    assert [verdict(before, frame) for frame in frames[:3]] == ["", "", ""]
    restarted = a_link(stamps=Stamps(memory.memory))
    assert [verdict(restarted, frame) for frame in frames] == ["replayed", "replayed", "replayed", ""]
    forgetful = a_link()
    assert verdict(forgetful, frames[0]) == ""  # which is why timestamps are stored


def test_timestamps_increase_after_a_restart_with_an_earlier_clock() -> None:
    memory = Stamps()
    plain = position(a_sender(key=None))
    last = a_link(stamps=memory).sign(plain, NOW_NS)
    assert stamp(a_link(stamps=Stamps(memory.memory)).sign(plain, NOW_NS - 3600 * 10**9)) == stamp(last) + 1


@given(bit=st.integers(0, 8 * (12 + 24 + 13) - 1), behind=st.integers(0, 1000))
def test_a_frame_with_any_flipped_bit_changes_nothing(bit: int, behind: int) -> None:
    stamps = Stamps()
    link, sender = a_link(stamps=stamps), a_sender(timestamp=NOW - behind)
    before, frame = position(sender), position(sender)
    assert len(frame) == 12 + 24 + 13
    assert verdict(link, before) == ""
    kept = bytes(stamps.memory)
    changed = bytearray(frame)
    changed[bit // 8] ^= 1 << bit % 8
    refused: Counter[str] = Counter()
    assert link.verify(bytes(changed), NOW_NS, refused) == b""
    assert refused.total() >= 1
    assert bytes(stamps.memory) == kept
    assert verdict(link, frame) == ""


@given(data=st.binary(max_size=400) | st.binary(max_size=400).map(lambda rest: b"\xfd" + rest))
def test_any_bytes_are_refused_and_change_nothing(data: bytes) -> None:
    stamps = Stamps()
    refused: Counter[str] = Counter()
    link, kept = a_link(stamps=stamps), bytes(stamps.memory)
    assert link.verify(data, NOW_NS, refused) == b""
    assert (refused.total() > 0) == bool(data)
    assert bytes(stamps.memory) == kept


@given(order=st.lists(st.integers(0, 40), max_size=120))
def test_in_any_order_each_frame_passes_at_most_once(order: list[int]) -> None:
    link, sender = a_link(), a_sender()
    frames = [position(sender) for _ in range(41)]
    reasons = [verdict(link, frames[k]) for k in order]
    taken = [k for k, reason in zip(order, reasons, strict=True) if reason == ""]
    assert taken == sorted(set(taken))
    seen: set[int] = set()
    for k, reason in zip(order, reasons, strict=True):
        if reason == "overtaken":
            assert k not in seen
        if k in seen:
            assert reason == "replayed"
        seen.add(k)


def test_codecs_neither_accept_nor_send_a_key() -> None:
    plain = dialect.MAVLink_setup_signing_message(1, 1, list(KEY), 0).pack(a_sender(key=None))
    refused: Counter[str] = Counter()
    assert mavlink.decode(plain, refused) == []
    assert refused == {"SETUP_SIGNING": 1}
    with pytest.raises(KeyError):
        mavlink.encode(mavlink.SETUP_SIGNING, (0, 1, 1, *KEY), sequence=0)


def test_too_many_streams_are_refused_known_ones_still_heard() -> None:
    link, sender = a_link(), a_sender()
    reasons = Counter[str]()
    for component in range(2):
        for link_id in range(256):
            for system in range(1, 11):
                sender.srcSystem, sender.srcComponent, sender.signing.link_id = system, component + 1, link_id
                reasons[verdict(link, position(sender))] += 1
    assert reasons == {"": 4094, "too many signing streams": 5120 - 4094}
    sender.srcSystem, sender.srcComponent, sender.signing.link_id = 1, 1, 0
    assert verdict(link, position(sender)) == ""
