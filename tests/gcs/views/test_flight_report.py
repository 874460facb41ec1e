"""report.html of a flight and its charts; the page is no wider than its window, even on a phone."""

import re
import subprocess
from pathlib import Path
from shutil import which

import numpy as np
import pytest

from gcs.control.tick import Event, Mode
from gcs.runs.files import read_summary
from gcs.runs.summary import finish
from gcs.views.flight_report import REPORT_FILE, flight_page, leave_report
from gcs.views.svg import Line, chart
from tests.support.fleets.flown_run import DESIGN, line, ticks_of, write_run

CHROMIUM = which("chromium") or which("chromium-browser") or which("google-chrome")


def report(folder: Path, vehicles: int, *, prediction: float | None = None) -> str:
    """The page of a run of five seconds, in the middle of which the first vehicle is CRITICAL for a second."""
    scenario = line(vehicles)
    if prediction is not None:
        control = scenario.control.model_copy(update={"prediction": prediction})
        scenario = scenario.model_copy(update={"control": control})
    ticks = ticks_of(scenario, start_s=-0.2, count=260)
    ticks["commanded"] = ticks["time_s"] >= 0.0
    ticks["mode"][130:180, 0] = Mode.CRITICAL
    write_run(folder, scenario, ticks)
    summary = leave_report(folder, finish(folder))
    assert REPORT_FILE in summary.files
    assert read_summary(folder / "summary.json").files == summary.files
    return (folder / REPORT_FILE).read_text(encoding="utf-8")


def test_report_has_verdict_charts_modes_links_and_events(tmp_path: Path) -> None:
    page = report(tmp_path, 3)
    for heading in ("Headroom", "Loop delay and margin", "Spacing errors", "Modes", "Vehicles and links", "Events"):
        assert f"<h2>{heading}</h2>" in page
    assert page.count("<svg") == 3
    assert "duration reached" in page


def test_headroom_with_prediction_is_not_called_delay_over_margin(tmp_path: Path) -> None:
    over_margin, mismatch = "1 − loop delay / margin", "1 − mismatch / mismatch tolerated"
    for name in "ab":
        (tmp_path / name).mkdir()
    without, predicted = report(tmp_path / "a", 3), report(tmp_path / "b", 3, prediction=0.05)
    assert over_margin in without
    assert mismatch not in without
    assert mismatch in predicted
    assert over_margin not in predicted
    assert "the loop delay could have been" not in predicted


def test_modes_are_of_vehicles_that_left_nominal_in_flight(tmp_path: Path) -> None:
    scenario = line(3)
    ticks = ticks_of(scenario, start_s=-0.2, count=260)
    ticks["mode"][:11] = ticks["mode"][-1:] = Mode.WAITING  # before the first command, and after the last
    ticks["mode"][130:180, 1] = Mode.CRITICAL
    write_run(tmp_path, scenario, ticks)
    leave_report(tmp_path, finish(tmp_path))
    page = (tmp_path / REPORT_FILE).read_text(encoding="utf-8")
    modes = page[page.index("<h2>Modes</h2>") :].split("</section>")[0]
    assert re.findall(r"<span>(\d+)</span>", modes) == ["2"]
    assert re.findall(r"</i>(\w+)</span>", modes) == ["NOMINAL", "CRITICAL", "WAITING"]


def test_simultaneous_events_of_vehicles_share_a_row(tmp_path: Path) -> None:
    report(tmp_path, 3)
    turned = [Event(time_s=0.02, kind="mode", system_id=k, text="WAITING -> NOMINAL") for k in (1, 2, 3)]
    ended = Event(time_s=5.0, kind="end", text="completed")
    scenario, ticks = line(3), ticks_of(line(3), start_s=0.0, count=250)
    page = flight_page(read_summary(tmp_path / "summary.json"), scenario, DESIGN, ticks, [*turned, ended])
    rows = re.findall(r"<td>([\d.]+)</td><td class=\"text ids\">([\d ]*)</td>", page)
    assert rows == [("0.02", "1 2 3"), ("5.00", "")]


def test_report_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    page = report(tmp_path, 3).replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"https?:|src=|<script|<link|@import", page)


def test_key_of_twenty_vehicles_names_the_three_with_least_headroom(tmp_path: Path) -> None:
    page = report(tmp_path, 20)
    named = re.findall(r"</i>vehicle (\d+)", page)
    assert sorted(named) == ["1", "2", "3"]  # the last in line have the oldest states
    assert "17 others" in page


def test_chart_keeps_every_peak_and_the_whole_time() -> None:
    time_s, values = np.arange(0.0, 60.0, 0.02), np.zeros(3000)
    values[1777] = 7.0
    drawn = chart(time_s, [Line(values, "1")], title="peak", unit="m")
    points = re.findall(r"([\d.]+),([\d.]+)", drawn[drawn.index("<polyline") :])
    assert len(points) < 600
    assert min(float(y) for _, y in points) == pytest.approx(12.0 + 190.0 / 8.0, abs=0.1)  # 7 on an axis to 8
    assert (float(points[0][0]), float(points[-1][0])) == (50.0, pytest.approx(548.0, abs=0.2))


def test_chart_breaks_its_line_where_nothing_is_known() -> None:
    values = np.array([1.0, 2.0, np.nan, 3.0, 4.0])
    assert chart(np.arange(5.0), [Line(values, "1")], title="gap", unit="m").count("<polyline") == 2
    assert chart(np.arange(5.0), [Line(np.full(5, np.nan))], title="none", unit="m").count("<polyline") == 0


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
@pytest.mark.parametrize("width", [1600, 400])
def test_report_is_no_wider_than_its_window(width: int, tmp_path: Path) -> None:
    report(tmp_path, 20)
    assert overflow_px(tmp_path / REPORT_FILE, width) <= 0


def overflow_px(page: Path, width: int) -> int:
    """By how much a page is wider than a window of this width, as a browser lays it out."""
    outer = page.with_name("outer.html")
    inner = page.read_text(encoding="utf-8").replace("&", "&amp;").replace('"', "&quot;")
    outer.write_text(
        f'<iframe id="page" style="border:0;width:{width}px;height:900px" srcdoc="{inner}"></iframe><p id="found"></p>'
        "<script>onload = () => { const one = document.getElementById('page');"
        "document.getElementById('found').textContent = 'overflow '"
        "+ (one.contentDocument.documentElement.scrollWidth - one.contentWindow.innerWidth); }</script>",
        encoding="utf-8",
    )
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={page.parent / 'user'}"]
    shown = subprocess.run([*command, "--dump-dom", outer.as_uri()], capture_output=True, text=True, check=True)
    found = re.search(r'id="found">overflow (-?\d+)', shown.stdout)
    assert found is not None
    return int(found[1])
