"""Refused datagrams are reported by reason, not too often, and can be read back from a run."""

from collections import Counter
from pathlib import Path

from gcs.control.tick import Event
from gcs.runs.files import RunTail
from gcs.runs.record import RunWriter
from gcs.runs.refusals import REFUSED, VEHICLES_FILE, Refusals, counts_of, in_words, refused_by_vehicles


def test_reasons_are_reported_once_and_counts_at_the_end() -> None:
    refusals, counters = Refusals(), Counter[str]()
    assert refusals.news(counters) == {}
    reported: list[tuple[int, dict[str, int]]] = []
    for k in range(50):
        counters["unsigned"] += 1
        counters["truncated"] += k >= 20
        counters += Counter[str]()  # removes reasons whose count is zero
        if counts := refusals.news(counters):
            reported.append((k, counts))
    assert reported == [(0, {"unsigned": 1}), (20, {"unsigned": 21, "truncated": 1})]
    assert refusals.news(counters, last=True) == {"unsigned": 50, "truncated": 30}
    assert refusals.news(counters, last=True) == {}


def test_the_vehicles_own_cameras_and_first_frames_are_no_refusals() -> None:
    counters = Counter({"other component": 3, "before a first heartbeat": 7})
    assert Refusals().news(counters, last=True) == {}


def test_a_run_holds_its_newest_counts_the_most_frequent_first(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path)
    for unsigned in (1, 5):
        counts = {"replayed": 2, "unsigned": unsigned}
        writer.event(Event(time_s=1.0, kind=REFUSED, text=in_words(counts), counts=counts))
    writer.event(Event(time_s=2.0, kind="end", text="completed"))
    writer.close()
    events = RunTail(tmp_path).events()
    assert [event.text for event in events] == ["2 replayed, 1 unsigned", "5 unsigned, 2 replayed", "completed"]
    assert counts_of(events, REFUSED) == {"replayed": 2, "unsigned": 5}
    assert counts_of([], REFUSED) == {}


def test_what_vehicles_counted_is_read_if_it_was_written(tmp_path: Path) -> None:
    assert refused_by_vehicles(tmp_path) is None
    (tmp_path / VEHICLES_FILE).write_text('{"setpoints": 10, "refused_wrong_signature": 3, "ignored_message": 1}')
    assert refused_by_vehicles(tmp_path) == {"wrong signature": 3}
    for damaged in ("half a fi", "[1, 2]", '{"refused_unsigned": "many"}'):
        (tmp_path / VEHICLES_FILE).write_text(damaged)
        assert refused_by_vehicles(tmp_path) is None
