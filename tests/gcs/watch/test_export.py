"""Runs and telemetry logs for other tools, read back by those tools' own libraries."""

import json
from pathlib import Path

import numpy as np
import pyarrow.csv
import pytest
from mcap.reader import make_reader

from gcs.drive.flown import fly_plan
from gcs.plan.planner import flight_plan
from gcs.runs.files import RunTail, read_ticks
from gcs.runs.record import TLOG_FILE
from gcs.watch.tlog import read_tlog
from scenarios.files import load
from tests.support.commands import exit_code
from tests.support.paths import SCENARIOS


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "run"
    scenario = load(SCENARIOS / "chain3.toml").model_copy(update={"duration_s": 3.0})
    fly_plan(flight_plan(scenario)[1], folder)
    return folder


def test_a_run_as_mcap_holds_every_value_of_every_tick(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "run.mcap"
    assert exit_code(monkeypatch, "export", run, "--mcap", file) == 0
    ticks, events = read_ticks(run), RunTail(run).events()
    with file.open("rb") as opened:
        reader = make_reader(opened)
        statistics = reader.get_summary()
        assert statistics is not None
        assert {channel.topic for channel in statistics.channels.values()} == {
            "/vehicle/1/tick", "/vehicle/2/tick", "/vehicle/3/tick", "/events",
        }  # fmt: skip
        schemas = {schema.name: json.loads(schema.data)["properties"] for schema in statistics.schemas.values()}
        assert set(schemas["ticks"]) == set(ticks.dtype.names or ())
        messages = [(channel.topic, json.loads(message.data)) for _, channel, message in reader.iter_messages()]
    assert [fields["text"] for topic, fields in messages if topic == "/events"] == [event.text for event in events]
    flown = ticks[ticks["system_id"] == 2]
    read = [fields for topic, fields in messages if topic == "/vehicle/2/tick"]
    for name in flown.dtype.names or ():
        values = np.array([fields.get(name, np.nan) for fields in read], dtype=float)
        finite = np.isfinite(flown[name].astype(float))
        assert np.array_equal(values[finite], flown[name].astype(float)[finite])
        assert np.isnan(values[~finite]).all()


def test_exported_times_are_on_one_clock_without_jumps(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert exit_code(monkeypatch, "export", run, "--csv", tmp_path / "csv") == 0
    rows = pyarrow.csv.read_csv(tmp_path / "csv" / "ticks.csv")
    times_ns = np.unique(rows["time_ns"].to_numpy())
    assert set(np.diff(times_ns).tolist()) == {20_000_000}  # 50 Hz, also where scenario time leaps to 0
    begun_ns = rows["time_ns"].to_numpy()[rows["time_s"].to_numpy() == 0.0][0]
    events = pyarrow.csv.read_csv(tmp_path / "csv" / "events.csv")
    at_start = events["time_ns"].to_numpy()[events["time_s"].to_numpy() == 0.0]
    assert set(at_start.tolist()) == {begun_ns}


def test_a_log_as_csv_has_one_file_per_message_kind(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (
        exit_code(monkeypatch, "export", run / TLOG_FILE, "--csv", tmp_path / "csv", "--mcap", tmp_path / "log.mcap")
        == 0
    )
    rows = 0
    for file in (tmp_path / "csv").iterdir():
        rows += pyarrow.csv.read_csv(file).num_rows
    frames = read_tlog(run / TLOG_FILE).frames
    assert rows == len(frames)
    positions = pyarrow.csv.read_csv(tmp_path / "csv" / "LOCAL_POSITION_NED.csv")
    assert set(positions["system_id"].to_pylist()) == {1, 2, 3}
    ticks = read_ticks(run)
    used = ticks[(ticks["system_id"] == 3) & (ticks["time_s"] > 1.0)][0]
    known = dict(zip(positions["time_boot_ms"].to_pylist(), positions["x"].to_pylist(), strict=True))
    assert known[used["sample_boot_ms"]] == pytest.approx(used["north_m"], abs=200.0)
    with (tmp_path / "log.mcap").open("rb") as opened:
        assert sum(1 for _ in make_reader(opened).iter_messages()) == len(frames)


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["nowhere", "--mcap", "x.mcap"], "nowhere: read no such file"),
        (["{run}"], "read neither --mcap nor --csv"),
        (["{run}/scenario.toml", "--csv", "csv"], "wanted a telemetry log (.tlog)"),
        (["{run}", "--csv", "{run}"], "--csv: "),
    ],
)
def test_what_cannot_be_exported_is_reported_in_one_line(
    arguments: list[str],
    wanted: str,
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert exit_code(monkeypatch, "export", *(text.format(run=run) for text in arguments)) == 2
    _, err = capsys.readouterr()
    assert wanted in err
    assert err.count("\n") == 1
