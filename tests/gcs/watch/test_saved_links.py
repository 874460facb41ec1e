"""Links measured, then flown: a profile saved from a flight leads to the same loop delay."""

from collections import Counter
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gcs.cli.main import app
from gcs.link import mavlink
from gcs.runs.files import read_summary
from gcs.runs.record import SUMMARY_FILE
from gcs.watch.saved_links import recorded
from scenarios.errors import ScenarioError
from scenarios.files import load, with_profile
from scenarios.link_files import load_profile
from scenarios.shipped import FOLDER, PROFILES, names

MS = 1_000_000


def run(*arguments: str) -> str:
    result = CliRunner().invoke(app, list(arguments), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_saved_links_lead_to_the_same_loop_delay(tmp_path: Path) -> None:
    profile = tmp_path / "measured.toml"
    run("fly", "chain3", "--links", "lte", "--virtual", "--out", str(tmp_path / "a"), "--json")
    said = run("replay", str(tmp_path / "a"), "--save-links", str(profile))
    assert "one-way delay" in said
    run("fly", "chain3", "--links", str(profile), "--virtual", "--out", str(tmp_path / "b"), "--json")
    first, again = (read_summary(tmp_path / name / SUMMARY_FILE).loop_delay_s for name in "ab")
    # other draws of the same delays; the 99th percentile rests on the slowest fifty of a trace
    assert again.p50 == pytest.approx(first.p50, rel=0.05)
    assert again.p99 == pytest.approx(first.p99, rel=0.15)
    measured = load_profile(str(profile), profile, "--links").measured
    assert measured is not None
    # the true median up is 15 ms + 1.678 * 3.79 ms; the clock splits the round trip within its bound
    assert measured.up.delay_s_p50 == pytest.approx(0.02136, abs=measured.up.calibration_error_s)
    assert measured.up.lost > 0


def test_links_are_found_relative_to_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "measured").mkdir()
    (tmp_path / "measured" / "links.toml").write_text((PROFILES / "lte.toml").read_text(encoding="utf-8"))
    monkeypatch.chdir(tmp_path)
    assert run("check", "chain3", "--links", "measured/links.toml") == run("check", "chain3", "--links", "lte")
    with pytest.raises(ScenarioError, match=r"^--links: read 'measured/none.toml', wanted one of"):
        run("check", "chain3", "--links", "measured/none.toml")


def test_every_shipped_profile_can_be_flown_and_names_its_source() -> None:
    assert names(PROFILES) == ["lte", "radio", "satellite", "wifi"]
    for name in names(PROFILES):
        profile = load_profile(name, FOLDER / "chain3.toml", "links.profile")
        assert profile.source
        assert profile.licence
        scenario = with_profile(load(FOLDER / "chain3.toml"), name, FOLDER / "chain3.toml")
        assert scenario.links.up == profile.up


def test_unknown_profile_is_one_line(tmp_path: Path) -> None:
    text = (FOLDER / "chain3.toml").read_text(encoding="utf-8")
    file = tmp_path / "own.toml"
    file.write_text(text.split("[links]")[0] + '[links]\nprofile = "nope"\n', encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"links\.profile.*one of lte, radio, satellite, wifi"):
        load(file)


def test_a_camera_with_the_vehicles_id_loses_no_frames() -> None:
    """It numbers its frames apart."""
    begin_ns = 1_000_000_000
    said: list[tuple[int, int, int, int, int, tuple[object, ...]]] = [
        (begin_ns, 1, 1, 0, mavlink.HEARTBEAT, (0, 2, 3, 0, 4, 3))
    ]
    for k in range(100):
        ns = begin_ns + 50 * MS * k
        said += [
            (ns, 255, 190, k, mavlink.TIMESYNC, (0, ns)),
            (ns + 10 * MS, 1, 1, 2 * k + 1, mavlink.TIMESYNC, (ns + 5 * MS, ns)),
            (ns + 20 * MS, 1, 1, 2 * k + 2, mavlink.LOCAL_POSITION_NED, (ns // MS + 15, *(0.0,) * 6)),
            (ns + 30 * MS, 1, 100, 77 + k, mavlink.HEARTBEAT, (0, 30, 8, 0, 4, 3)),
        ]
    frames: list[tuple[int, mavlink.Frame]] = []
    for time_ns, system_id, component_id, sequence, msg_id, fields in said:
        [frame] = mavlink.decode(mavlink.encode(msg_id, fields, sequence=sequence, system_id=system_id), Counter())
        frames.append((time_ns, frame._replace(component_id=component_id)))
    measured = recorded(frames).profile("here").measured
    assert measured is not None
    assert (measured.up.datagrams > 100, measured.up.lost) == (True, 0)
