"""Telemetry logs: what is whole is read, however it was written and whatever happened to the rest."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pymavlink.dialects.v10 import ardupilotmega as dialect_1
from pymavlink.dialects.v20 import ardupilotmega as dialect_2

from gcs.errors import InputError
from gcs.link import mavlink
from gcs.link.datagram import Arrivals, Frames
from gcs.runs.record import TLOG_FILE, RunWriter
from gcs.watch.tlog import parse_tlog, read_tlog
from scenarios.sockets import joined
from tests.support.station_peer import address_at

START_US = 1_750_000_000_000_000
ENTRIES = [
    (START_US + k * 20_000, mavlink.encode(mavlink.TIMESYNC, (k, 1000 + k), sequence=k & 0xFF)) for k in range(60)
]


def logged(entries: list[tuple[int, bytes]]) -> bytes:
    return b"".join(struct.pack(">Q", stamp_us) + frame for stamp_us, frame in entries)


def found(data: bytes) -> list[tuple[int, bytes]]:
    return [(time_ns // 1000, frame.data) for time_ns, frame in parse_tlog(data).frames]


def test_what_a_run_writes_is_read_back_with_its_times(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path)
    writer.frames(Frames((frame, stamp_us * 1000 + 999, 0) for stamp_us, frame in ENTRIES))
    writer.close()
    log = read_tlog(tmp_path / TLOG_FILE)
    assert [(time_ns, frame.data) for time_ns, frame in log.frames] == [(us * 1000, frame) for us, frame in ENTRIES]
    assert log.counters == {}


def test_frames_of_several_networks_are_logged_apart_in_order(tmp_path: Path) -> None:
    stream, ends = joined([frame for _, frame in ENTRIES])
    times_ns = [1000 * us + 999 for us, _ in ENTRIES]
    addresses = [address_at("10.0.0.1", port, network) for port, network in ((1, 0), (1, 2), (2, 2))]
    table = np.array([ends[:-1], ends[1:], [addresses[k % 3] for k in range(len(ENTRIES))], times_ns])
    frames = Frames()
    frames.add(Arrivals(stream, table, np.zeros(len(ENTRIES), np.int64)), 0, 40)
    frames.append((ENTRIES[40][1], times_ns[40] - 7_000_000, addresses[1]))
    frames.add(Arrivals(stream, table, np.zeros(len(ENTRIES), np.int64)), 41)
    writer = RunWriter(tmp_path)
    writer.frames(frames, 7_000_000)
    writer.close()
    for name, places in (("flight.tlog", (0,)), ("flight-2.tlog", (1, 2))):
        own = [(us + 7_000 * (k != 40), frame) for k, (us, frame) in enumerate(ENTRIES) if k % 3 in places]
        assert (tmp_path / name).read_bytes() == logged(own)


@pytest.mark.parametrize("dialect", [dialect_1, dialect_2], ids=["MAVLink 1", "MAVLink 2"])
def test_both_versions_of_mavlink_are_read_with_the_same_fields(dialect: Any) -> None:
    sender = dialect.MAVLink(None, srcSystem=7, srcComponent=1)
    heartbeat = dialect.MAVLink_heartbeat_message(2, 3, 81, 4, 3, 3)
    position = dialect.MAVLink_local_position_ned_message(1234, 1.0, -2.0, 3.0, 0.5, 0.0, 0.0)
    packed = [(START_US, heartbeat.pack(sender)), (START_US + 4, position.pack(sender))]
    frames = [frame for _, frame in parse_tlog(logged(packed)).frames]
    assert [(frame.system_id, frame.component_id) for frame in frames] == [(7, 1)] * 2
    assert frames[0].fields == (4, 2, 3, 81, 3, 3)
    assert frames[1].fields == (1234, 1.0, -2.0, 3.0, 0.5, 0.0, 0.0)


@given(st.integers(1, len(logged(ENTRIES))))
def test_logs_cut_anywhere_give_all_whole_frames_before_the_cut(length: int) -> None:
    entry_bytes = 8 + len(ENTRIES[0][1])
    sizes = [len(logged(ENTRIES[:k])) for k in range(len(ENTRIES) + 1)]
    whole = sum(size <= length for size in sizes) - 1
    log = parse_tlog(logged(ENTRIES)[:length])
    assert [frame.data for _, frame in log.frames] == [frame for _, frame in ENTRIES[:whole]]
    assert log.counters["damaged bytes"] == length - sizes[whole] < entry_bytes + 1


@example(39, b"\x82\x02")  # length and flags: a frame of an unknown kind that ends where another one does
@given(st.integers(0, len(logged(ENTRIES)) - 1), st.binary(min_size=1, max_size=40))
def test_damage_costs_only_the_frames_it_touches(at: int, noise: bytes) -> None:
    data = bytearray(logged(ENTRIES))
    noise = noise[: len(data) - at]
    data[at : at + len(noise)] = noise
    seen = set(found(bytes(data)))
    start = 0
    for entry in ENTRIES:
        end = start + 8 + len(entry[1])
        if end <= at or start >= at + len(noise):
            assert entry in seen
        start = end


@given(st.binary(max_size=300))
def test_any_bytes_are_taken_without_an_exception(data: bytes) -> None:
    log = parse_tlog(data)
    assert len(log.frames) * 8 + log.counters["damaged bytes"] <= len(data)


def test_frames_with_a_wrong_time_are_left_out_and_counted() -> None:
    entries = list(ENTRIES)
    entries[30] = (entries[30][0] + 3_600_000_000, entries[30][1])
    entries[0] = (5, entries[0][1])
    log = parse_tlog(logged(entries))
    assert log.counters["wrong time stamps"] == 2
    assert [(time_ns // 1000, frame.data) for time_ns, frame in log.frames] == [*ENTRIES[1:30], *ENTRIES[31:]]


def test_a_pause_in_a_log_is_no_wrong_time() -> None:
    later = [(stamp_us + 90_000_000 * (k >= 30), frame) for k, (stamp_us, frame) in enumerate(ENTRIES)]
    assert found(logged(later)) == later


def test_messages_of_another_dialect_are_stepped_over() -> None:
    unknown = bytearray(ENTRIES[0][1])
    unknown[7:10] = (59999).to_bytes(3, "little")
    log = parse_tlog(logged([ENTRIES[0], (START_US + 4, bytes(unknown)), ENTRIES[1]]))
    assert len(log.frames) == 2
    assert log.counters == {"unknown message": 1}


def test_a_file_without_a_frame_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "empty.tlog"
    file.touch()
    with pytest.raises(InputError, match="read no MAVLink frame in 0 bytes"):
        read_tlog(file)
    with pytest.raises(InputError, match="No such file"):
        read_tlog(tmp_path / "nowhere.tlog")
