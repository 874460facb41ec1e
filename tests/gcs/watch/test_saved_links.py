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
from scenarios.keys.link import Link
from scenarios.keys.profile import Measured
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


def test_links_without_delay_can_be_replayed_and_saved(tmp_path: Path) -> None:
    """Requests and their replies have the same time in the log."""
    out = str(tmp_path / "a")
    flown = run("fly", "chain3", "--link-delay", "0", "--virtual", "--out", out).splitlines()
    replayed = run("replay", out, "--save-links", str(tmp_path / "none.toml")).splitlines()
    for heading in ("verdict", "delay"):
        assert [line for line in flown if line.startswith(heading)] == [
            line for line in replayed if line.startswith(heading)
        ]


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


def test_an_unknown_profile_is_refused(tmp_path: Path) -> None:
    text = (FOLDER / "chain3.toml").read_text(encoding="utf-8")
    file = tmp_path / "own.toml"
    file.write_text(text.split("[links]")[0] + '[links]\nprofile = "nope"\n', encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"links\.profile.*one of lte, radio, satellite, wifi"):
        load(file)


Said = tuple[int, int, int, tuple[object, ...]]
"""Time sent in ms, sequence number, message and its fields."""


def exchange(k: int, boot_ms: int) -> list[Said]:
    """The k-th request, its reply and a position, by a vehicle whose clock shows `boot_ms` at the request."""
    ms = 1_000 + 50 * k
    return [
        (ms, -1, mavlink.TIMESYNC, (0, ms * MS)),
        (ms + 10, 2 * k + 1, mavlink.TIMESYNC, ((boot_ms + 5) * MS, ms * MS)),
        (ms + 20, 2 * k + 2, mavlink.LOCAL_POSITION_NED, (boot_ms + 15, *(0.0,) * 6)),
    ]


def measured_of(said: list[Said], others: tuple[tuple[int, mavlink.Frame], ...] = ()) -> tuple[Measured, Link]:
    """What is measured of a vehicle, and the link up of its profile."""
    first: Said = (1_000, 0, mavlink.HEARTBEAT, (0, 2, 3, 0, 4, 3))
    frames = [*others]
    for time_ms, sequence, msg_id, fields in [first, *said]:
        station = sequence < 0
        system_id, component_id = (255, 190) if station else (1, 1)
        data = mavlink.encode(msg_id, fields, sequence=max(0, sequence), system_id=system_id)
        [frame] = mavlink.decode(data, Counter())
        frames.append((time_ms * MS, frame._replace(component_id=component_id)))
    profile = recorded(sorted(frames, key=lambda each: each[0])).profile("here")
    assert profile.measured is not None
    assert profile.up is not None
    return profile.measured, profile.up


def test_a_camera_with_the_vehicles_id_loses_no_frames() -> None:
    """It numbers its frames separately."""
    cameras = []
    for k in range(100):
        data = mavlink.encode(mavlink.HEARTBEAT, (0, 30, 8, 0, 4, 3), sequence=77 + k, system_id=1)
        [frame] = mavlink.decode(data, Counter())
        cameras.append(((1_030 + 50 * k) * MS, frame._replace(component_id=100)))
    said = [each for k in range(100) for each in exchange(k, 50 * k)]
    measured, _ = measured_of(said, tuple(cameras))
    assert (measured.up.datagrams > 100, measured.up.lost) == (True, 0)


def test_overtaken_frames_count_as_reordered_not_lost() -> None:
    said = [each for k in range(100) for each in exchange(k, 50 * k)]
    late = [(ms + (60 if sequence % 20 == 10 else 0), sequence, kind, fields) for ms, sequence, kind, fields in said]
    measured, up = measured_of(late)
    assert (measured.up.lost, measured.up.loss_runs, up.reordering) == (0, 0, True)
    assert measured_of(said)[1].reordering is False


@pytest.mark.parametrize("exchanges", [10, 100, 200])
def test_a_run_of_losses_of_any_length_is_counted(exchanges: int) -> None:
    """200 exchanges are 400 frames, past the range of a sequence number."""
    said = [each for k in range(400) for each in exchange(k, 50 * k) if not 100 <= k < 100 + exchanges]
    measured, _ = measured_of(said)
    assert (measured.up.lost, measured.up.loss_runs) == (2 * exchanges, 1)


@pytest.mark.parametrize("jump_ms", [-3_000, 2_000])
def test_a_clock_that_jumps_delays_nothing(jump_ms: int) -> None:
    """Positions between the jump and the next exchange show no delay, nor do old ones that are sent once more."""
    boots_ms = [10_000 + 50 * k for k in range(200)]
    said = [each for k, boot_ms in enumerate(boots_ms[:100]) for each in exchange(k, boot_ms)]
    said += (
        exchange(100, boots_ms[100])[:2] + exchange(100, boots_ms[100] + jump_ms)[2:]
    )  # it jumps before the position
    said += [each for k in range(101, 200) for each in exchange(k, boots_ms[k] + jump_ms)]
    said += [(11_000 + 50 * k, 401 + k, *said[-1][2:]) for k in range(50)]
    measured, _ = measured_of(said)
    assert measured.up.delay_s_p50 == pytest.approx(0.005, abs=0.001)
    assert measured.up.variation_s_p99 < 0.002
