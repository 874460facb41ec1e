"""The summary of a run as a record: what is written is read back, and older files are read as far as they go."""

import json
from pathlib import Path
from typing import Any

import pytest

from gcs.errors import InputError
from gcs.runs.files import read_summary
from gcs.runs.record import SUMMARY_FILE
from gcs.runs.summary import finish
from tests.support.fleets.flown_run import line, ticks_of, write_run

OLDER: dict[str, Any] = {
    "verdict": "stable",
    "loop": "ground",
    "delay_margin_s": 0.3,
    "loop_delay_s": {"p50": 0.1, "p99": 0.2, "max": 0.3},
    "headroom_min": 0.5,
    "a field of another version": 1,
}


def test_a_summary_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    scenario = line(3)
    write_run(tmp_path, scenario, ticks_of(scenario, start_s=0.0, count=100))
    summary = finish(tmp_path)
    assert read_summary(tmp_path / SUMMARY_FILE).to_dict() == summary.to_dict()
    assert (
        json.loads((tmp_path / SUMMARY_FILE).read_text(encoding="utf-8")) == {"schema_version": 1} | summary.to_dict()
    )


def test_an_older_runs_summary_is_read_without_later_fields(tmp_path: Path) -> None:
    (tmp_path / SUMMARY_FILE).write_text(json.dumps(OLDER), encoding="utf-8")
    summary = read_summary(tmp_path / SUMMARY_FILE)
    assert (summary.verdict, summary.loop_delay_s.p95, summary.vehicles) == ("stable", None, ())


@pytest.mark.parametrize("missing", [name for name in OLDER if not name.startswith("a ")])
def test_summaries_without_verdict_or_figures_are_refused_in_one_line(missing: str, tmp_path: Path) -> None:
    left = {name: value for name, value in OLDER.items() if name != missing}
    (tmp_path / SUMMARY_FILE).write_text(json.dumps(left), encoding="utf-8")
    with pytest.raises(InputError, match=f"summary.json: {missing}: missing; wanted the summary of a run"):
        read_summary(tmp_path / SUMMARY_FILE)
