"""The Rerun recording says what the ticks say, and the viewer can draw it."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rerun.chunk import RrdReader

from gcs.control.tick import TICK, Event, Mode, TickArray
from gcs.errors import InputError
from gcs.plan.design import Design
from gcs.runs.files import RunTail, by_tick
from gcs.runs.record import PARQUET_FILE, RECORDING_FILE, TICKS_FILE, UNFINISHED_FILE
from gcs.views.observer import record_run
from gcs.views.recording import Recording
from gcs.views.scene import vehicle_colors
from gcs.views.viewer import find_recording, view
from tests.support.fleets.flown_run import DESIGN, SPEED_M_S, line, ticks_of, write_run
from tests.support.recordings import read_back

FIVE = line(5)


def spacing_errors_m(ticks: TickArray) -> Any:
    return np.hypot(ticks["spacing_error_north_m"], ticks["spacing_error_east_m"])[:, 1:]


def test_every_followers_spacing_error_is_recorded_at_every_tick(tmp_path: Path) -> None:
    ticks = ticks_of(FIVE, start_s=0.0, count=120)
    write_run(tmp_path, FIVE, ticks)
    times_s, errors_m = read_back(record_run(tmp_path), "/spacing/error_m", "Scalars:scalars")
    np.testing.assert_allclose(times_s, ticks["time_s"][:, 0], atol=1e-9)
    np.testing.assert_array_equal(errors_m, spacing_errors_m(ticks))


def test_a_run_with_ticks_in_parquet_is_recorded_alike(tmp_path: Path) -> None:
    ticks = ticks_of(FIVE, start_s=0.0, count=120)
    write_run(tmp_path, FIVE, ticks)
    rows = ticks.ravel()
    pq.write_table(pa.table({name: rows[name] for name in TICK.names or ()}), tmp_path / PARQUET_FILE)
    (tmp_path / TICKS_FILE).unlink()
    _, errors_m = read_back(record_run(tmp_path), "/spacing/error_m", "Scalars:scalars")
    np.testing.assert_array_equal(errors_m, spacing_errors_m(ticks))


def test_sending_in_pieces_records_the_same_as_sending_at_once(tmp_path: Path) -> None:
    ticks = ticks_of(FIVE, start_s=0.0, count=200)
    found: list[Any] = []
    for pieces in (1, 40):
        with Recording(tmp_path, FIVE, DESIGN) as recording:
            for piece in np.split(ticks, pieces):
                recording.add(piece, [])
                recording.send()
        file = tmp_path / RECORDING_FILE
        entities = ("/spacing/error_m", "/delay/rtt_ms", "/headroom/percent")
        series = [read_back(file, entity, "Scalars:scalars") for entity in entities]
        scene = [read_back(file, "/formation/vehicles", "Points3D:positions")]
        found.append([*series, *scene, read_back(file, "/ground/trails", "LineStrips3D:strips")])
    for at_once, in_pieces in zip(*found, strict=True):
        np.testing.assert_array_equal(in_pieces[0], at_once[0])
        np.testing.assert_array_equal(in_pieces[1], at_once[1])


def test_positions_are_brought_to_the_ticks_instant(tmp_path: Path) -> None:
    # Every vehicle flies exactly in its place, but the states are 10 to 50 ms old: up to 2 m at 50 m/s.
    ticks = ticks_of(FIVE, start_s=0.0, count=50)
    assert np.ptp(ticks["telemetry_age_s"]) * SPEED_M_S > 1.5
    write_run(tmp_path, FIVE, ticks)
    _, seen_m = read_back(record_run(tmp_path), "/formation/vehicles", "Points3D:positions")
    wanted_m = [(-30.0 * k, 40.0 * k, 0.0) for k in range(5)]
    np.testing.assert_allclose(seen_m, np.broadcast_to(wanted_m, seen_m.shape), atol=1e-3)  # float32 at 100 m


def test_trails_join_up_to_the_path_flown(tmp_path: Path) -> None:
    write_run(tmp_path, FIVE, ticks_of(FIVE, start_s=0.0, count=101))
    _, pieces_m = read_back(record_run(tmp_path), "/ground/trails", "LineStrips3D:strips")
    np.testing.assert_array_equal(pieces_m[1:, :, 0], pieces_m[:-1, :, 1])
    np.testing.assert_allclose(pieces_m[-1, :, 1, 0] - pieces_m[0, :, 0, 0], 2.0 * SPEED_M_S, atol=0.1)


def test_unknowns_stay_unknown_and_round_trips_last_until_the_next(tmp_path: Path) -> None:
    ticks = ticks_of(FIVE, start_s=0.0, count=20)
    ticks["loop_delay_s"][5:10, 2] = np.nan
    write_run(tmp_path, FIVE, ticks)
    file = record_run(tmp_path)
    _, loop_delay_ms = read_back(file, "/delay/loop_ms", "Scalars:scalars")
    np.testing.assert_array_equal(np.isnan(loop_delay_ms), np.isnan(ticks["loop_delay_s"]))
    _, rtt_ms = read_back(file, "/delay/rtt_ms", "Scalars:scalars")
    np.testing.assert_allclose(rtt_ms, 50.0)


def test_events_before_the_flight_stand_at_the_recordings_start(tmp_path: Path) -> None:
    write_run(tmp_path, FIVE, ticks_of(FIVE, start_s=-1.0, count=100))
    file = record_run(tmp_path)
    times_s, _ = read_back(file, "/headroom/percent", "Scalars:scalars")
    assert times_s[0] == pytest.approx(0.0, abs=1e-9)
    events = [chunk.to_record_batch() for chunk in RrdReader(file).stream().filter(content="/events")]
    texts = [text for batch in events for [text] in batch.column("TextLog:text").to_pylist()]
    assert [text.split() for text in texts] == [
        ["start", "+19.00", "s", "phase", "connecting"],  # 1 s before start-up is given up, which is after 20 s
        ["0.98", "s", "end", "duration", "reached"],
    ]


def test_the_same_event_of_several_vehicles_is_one_entry(tmp_path: Path) -> None:
    said = [("NOMINAL -> CAUTION", 4), ("NOMINAL -> CAUTION", 3), ("NOMINAL -> LOST", 2), ("NOMINAL -> CAUTION", 1)]
    with Recording(tmp_path, FIVE, DESIGN) as recording:
        events = [Event(time_s=2.5, kind="mode", system_id=system_id, text=text) for text, system_id in said]
        recording.add(ticks_of(FIVE, start_s=0.0, count=5), events)
    [chunk] = RrdReader(tmp_path / RECORDING_FILE).stream().filter(content="/events")
    batch = chunk.to_record_batch()
    assert batch.column("TextLog:text").to_pylist() == [
        ["    2.50 s  mode  vehicles 4 3: NOMINAL -> CAUTION"],
        ["    2.50 s  mode  vehicle 2: NOMINAL -> LOST"],
        ["    2.50 s  mode  vehicle 1: NOMINAL -> CAUTION"],
    ]
    assert batch.column("TextLog:level").to_pylist() == [["WARN"], ["ERROR"], ["WARN"]]


def test_without_a_screen_the_viewer_is_not_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / RECORDING_FILE).write_bytes(b"RRF2")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(InputError, match="no screen here"):
        view(tmp_path / RECORDING_FILE)


def test_a_change_of_mode_is_one_entry_of_its_vehicle(tmp_path: Path) -> None:
    ticks = ticks_of(FIVE, start_s=0.0, count=50)
    ticks["mode"][20:30, 1] = Mode.LOST
    write_run(tmp_path, FIVE, ticks)
    file = record_run(tmp_path)
    found: dict[str, list[str]] = {}
    for chunk in RrdReader(file).stream().filter(content="/modes/**", is_static=False):
        states = chunk.to_record_batch().column("StateChange:state").to_pylist()
        found.setdefault(chunk.entity_path, []).extend(state for [state] in states)
    assert found.pop("/modes/4") == ["NOMINAL", "LOST", "NOMINAL"]
    assert found == {f"/modes/{k}": ["NOMINAL"] for k in (1, 2, 3, 5)}


def test_the_recording_contains_its_blueprint(tmp_path: Path) -> None:
    with Recording(tmp_path, FIVE, DESIGN):
        assert (tmp_path / UNFINISHED_FILE).exists()
        assert not (tmp_path / RECORDING_FILE).exists()
    assert not (tmp_path / UNFINISHED_FILE).exists()
    assert len(RrdReader(tmp_path / RECORDING_FILE).blueprints()) == 1


def test_gains_without_a_finite_margin_draw_no_margin(tmp_path: Path) -> None:
    ticks = ticks_of(FIVE, start_s=0.0, count=5)
    ticks["delay_margin_s"] = np.inf
    with Recording(tmp_path, FIVE, Design(delay_margin_s=np.inf)) as recording:
        recording.add(ticks, [])
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / RECORDING_FILE).stream()}
    drawn = "/delay/margin_ms" in paths and any(
        chunk.entity_path == "/delay/margin_ms" and not chunk.is_static
        for chunk in RrdReader(tmp_path / RECORDING_FILE).stream()
    )
    assert not drawn


def test_ticks_are_given_when_whole_in_the_order_asked_for(tmp_path: Path) -> None:
    ticks, tail = ticks_of(FIVE, start_s=0.0, count=3), RunTail(tmp_path, 5)
    data, row = ticks.tobytes(), ticks.itemsize
    for end, whole in ((3 * row, 0), (7 * row, 1), (15 * row, 2), (15 * row, 0)):
        (tmp_path / TICKS_FILE).write_bytes(data[:end])
        assert len(by_tick(tail.ticks(), [1, 2, 3, 4, 5])) == whole
    (tmp_path / TICKS_FILE).write_bytes(data[: 12 * row])  # a station killed in its third tick
    found = by_tick(RunTail(tmp_path).ticks(), [1, 2, 3, 4, 5])
    assert found["system_id"].tolist() == [[1, 2, 3, 4, 5]] * 2
    assert found[:, ::-1].tobytes() == ticks[:2].tobytes()


@pytest.mark.parametrize("count", [5, 20, 250])
def test_every_vehicle_has_a_colour_of_its_own(count: int) -> None:
    assert len(set(vehicle_colors(count))) == count


def test_a_missing_recording_is_named_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: read no such file, wanted a run folder or an .rrd file"):
        find_recording(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"read no flight\.rrd"):
        find_recording(tmp_path)
    (tmp_path / UNFINISHED_FILE).touch()
    with pytest.raises(InputError, match=r"read a recording that is not finished"):
        find_recording(tmp_path)
    (tmp_path / RECORDING_FILE).write_bytes(b"RRF2")
    assert find_recording(tmp_path) == find_recording(tmp_path / RECORDING_FILE) == tmp_path / RECORDING_FILE
    (tmp_path / RECORDING_FILE).write_bytes(b"")
    with pytest.raises(InputError, match=r"flight\.rrd: read a file of another kind, wanted a recording of a run"):
        find_recording(tmp_path)


def test_a_recovered_recording_leaves_out_a_half_written_tick(tmp_path: Path) -> None:
    ticks = ticks_of(FIVE, start_s=0.0, count=30)
    write_run(tmp_path, FIVE, ticks)
    with (tmp_path / TICKS_FILE).open("r+b") as file:
        file.truncate(ticks.nbytes - 10)
    _, errors_m = read_back(record_run(tmp_path), "/spacing/error_m", "Scalars:scalars")
    np.testing.assert_array_equal(errors_m, spacing_errors_m(ticks)[:-1])


def test_a_formation_of_one_vehicle_can_be_recorded(tmp_path: Path) -> None:
    scenario = line(1)
    write_run(tmp_path, scenario, ticks_of(scenario, start_s=0.0, count=30))
    _, headroom = read_back(record_run(tmp_path), "/headroom/percent", "Scalars:scalars")
    assert headroom.shape == (30, 1)
