"""A disk that fills up while logs are written: no record is torn, and what was written before remains usable."""

import json
import resource
import signal
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gcs.control.tick import Event
from gcs.errors import InputError
from gcs.link.datagram import Frames
from gcs.runs.files import RunTail, read_ticks
from gcs.runs.summary import finish
from gcs.stress.campaign import trials_of
from gcs.stress.trial import Outcome
from tests.support.fleets.flown_run import line, prepare, ticks_of

THREE = line(3)


@contextmanager
def disk_full_at(size: int) -> Generator[None]:
    """Within this context, no file of this process grows past a size."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limit[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, before)


@pytest.mark.parametrize("part", [0, 1, 200, 700])
def test_the_tick_log_ends_with_its_last_whole_tick(part: int, tmp_path: Path) -> None:
    ticks = ticks_of(THREE, start_s=0.0, count=60)
    writer = prepare(tmp_path, THREE)
    for rows in ticks[:20]:
        writer.tick(rows)
    with disk_full_at(ticks[:20].nbytes + part):
        for rows in ticks[20:40]:
            writer.tick(rows)
            writer.frames(Frames([(b"frame", 1, 0)]))
    for rows in ticks[40:]:  # there is room again, but a gap would look like ticks that were missed
        writer.tick(rows)
    writer.event(Event(time_s=1.2, kind="end", text="completed: duration reached"))
    assert writer.close() == []
    assert read_ticks(tmp_path).tobytes() == ticks[:20].tobytes()
    summary = finish(tmp_path)
    assert (summary.verdict, summary.reason) == ("unknown", "completed: duration reached")
    assert summary.not_logged == ("ticks.part: File too large, from 0.40 s on",)
    assert (tmp_path / "flight.tlog").read_bytes().count(b"frame") == 20


def test_events_wait_until_they_can_be_written(tmp_path: Path) -> None:
    writer = prepare(tmp_path, THREE)
    writer.event(Event(time_s=0.0, kind="phase", text="flying"))
    with disk_full_at((tmp_path / "events.jsonl").stat().st_size + 10):
        writer.event(Event(time_s=1.0, kind="mode", text="first"))
        writer.event(Event(time_s=2.0, kind="mode", text="second"))
    assert [event.text for event in RunTail(tmp_path).events()] == ["flying"]
    writer.event(Event(time_s=3.0, kind="mode", text="third"))
    assert [event.text for event in RunTail(tmp_path).events()] == ["flying", "first", "second", "third"]
    with disk_full_at((tmp_path / "events.jsonl").stat().st_size):
        writer.event(Event(time_s=4.0, kind="end", text="completed: duration reached"))
        unwritten = writer.close()
    assert [event.kind for event in unwritten] == ["end"]


def test_a_flight_is_summarised_though_its_summary_cannot_be_written(tmp_path: Path) -> None:
    writer = prepare(tmp_path, THREE)
    for rows in ticks_of(THREE, start_s=0.0, count=50):
        writer.tick(rows)
    with disk_full_at(1):
        writer.event(Event(time_s=1.0, kind="end", text="completed: duration reached"))
        unwritten = writer.close()
        summary = finish(tmp_path, unwritten=unwritten)
    assert summary.reason == "completed: duration reached"
    named = [text.split(":")[0] for text in summary.not_logged]
    assert named == ["events.jsonl", "flight.rrd", "ticks.parquet", "summary.json"]
    assert "summary.json" not in summary.files
    assert not list(tmp_path.glob("*.new"))
    finish(tmp_path)  # as gcs recover does once there is room
    assert json.loads((tmp_path / "summary.json").read_text())["duration_s"] == summary.duration_s


def test_a_failed_campaign_ends_in_one_line_and_keeps_trials(tmp_path: Path) -> None:
    one, two = (Outcome(id=name, kind="own", seed=1, coordinates={}, real_time=False) for name in ("one", "two"))
    store = trials_of(tmp_path)
    store.add(one)
    with (
        disk_full_at(store.file.stat().st_size + 20),
        pytest.raises(InputError, match=r"trials\.jsonl: File too large; 1 flights are stored; continue with --resume"),
    ):
        store.add(two)
    store.close()
    again = trials_of(tmp_path)
    assert list(again.flown) == ["one"]
    again.add(two)
    again.close()
    assert store.file.read_bytes().count(b"\n") == 2
