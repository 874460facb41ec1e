"""Input that a command cannot use, as `main` meets it: one line with what was read and what was wanted, exit code 2."""

import itertools
from pathlib import Path

import pytest

from gcs.cli.options import listening, mirroring
from gcs.errors import InputError
from gcs.runs.record import DESIGN_FILE, EVENTS_FILE, PARQUET_FILE, SCENARIO_FILE, SUMMARY_FILE, TICKS_FILE, TRUTH_FILE
from gcs.runs.summary import finish, summarise
from gcs.views.observer import record_run
from gcs.views.report import print_summary
from scenarios.shipped import FOLDER, located
from tests.support.commands import complaint
from tests.support.fleets.flown_run import DESIGN, line, ticks_of, write_run
from tests.support.paths import ROOT

CHAIN = "scenarios/chain3.toml"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a complete run, which arguments name as `{run}`."""
    folder = tmp_path / "run"
    folder.mkdir()
    scenario = line(3)
    write_run(folder, scenario, ticks_of(scenario, start_s=0.0, count=100))
    return folder


@pytest.fixture(autouse=True)
def _in_the_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ("view {run} --picture /proc/x.png", "--picture: /proc/x.png: No such file or directory, wanted a file that"),
        ("view {run} --picture {run}", "run: Is a directory, wanted a file that can be written"),
        ("view {run} --picture {run}/a.png --at nan", "--at: read nan, wanted seconds from"),
        ("view {run} --picture {run}/a.png --at 1e300", "--at: read 1e+300, wanted seconds from"),
        ("grade README.md", "README.md/truth.bin: Not a directory, wanted the truth log in a run's folder"),
        ("scenarios --linkz", "No such option: --linkz; did you mean --links?"),
        ("view README.md", "README.md: read a file of another kind, wanted a recording of a run (.rrd)"),
        (f"fly {CHAIN} --link-delay nan", "--link-delay: read nan, wanted seconds from 0 to 60"),
        (f"fly {CHAIN} --link-delay 150ms", "--link-delay: read '150ms', wanted a valid number"),
        (f"bench {CHAIN} --vehicles -3", "--vehicles: read -3, wanted a number from 0 to 1000"),
        (f"design {CHAIN} --at 1 --maximise speed", "--maximise: read 'speed', wanted one of 'alpha', 'decay'"),
        (
            f"stress {CHAIN} --onset --out /proc/x",
            "--out: /proc/x: No such file or directory, wanted a folder that can",
        ),
        (f"stress {CHAIN} --onset --out README.md", "--out: README.md: File exists, wanted a folder that can"),
        (f"stress {CHAIN} --onset --out {{run}}", "run is not empty, wanted a new or empty folder, or --resume"),
        (f"stress {CHAIN} --onset --junit {{run}}", "run: Is a directory, wanted a file that can be written"),
        (f"stress {CHAIN} --onset --tolerance nan", "--tolerance: read nan, wanted a fraction between 0 and 1"),
        (f"stress {CHAIN} --delay 0:x:3", "--delay: "),
        (f"stress {CHAIN} --delay 0:1:1000000000", "--delay: read '0:1:1000000000', wanted FROM:TO:N or a list"),
        (f"stress {CHAIN} --delay 0:600:3", "0.1,0.2, of at most 10000 values from 0 to 60 s"),
        (f"stress {CHAIN} --rate 0", "from 1 to 500 Hz"),
        (f"stress {CHAIN} --delay-of 3=0.1,0.2 --delay-of 3=0.3,0.4", "--delay-of: read vehicle 3 twice, wanted two"),
        (
            f"stress {CHAIN} --onset --trial x --out README.md",
            "--out: read README.md, wanted the folder of a campaign,",
        ),
        (f"capacity {CHAIN} --resume", "--resume: read no --out, wanted --out with the folder of a study"),
        (f"fly {CHAIN} --virtual --out README.md", "--out: README.md: File exists, wanted a folder that can"),
        (f"fly {CHAIN} --virtual --out {{run}}", "run is not empty, wanted a new or empty folder"),
        (f"bench {CHAIN} --seconds 1e9", "86400"),
        (f"bench {CHAIN} --workers 3", "read --workers without --cluster, wanted it with --cluster"),
        (f"design {CHAIN} --save {{run}}/new.toml", "read --save without --at or --links-of, wanted it with --at or"),
        (f"design {CHAIN} --predict on", "read --predict without --at, wanted it with --at"),
        (f"design {CHAIN} --picture {{run}}/front.svg", "read --picture without --front, wanted it with --front"),
        (f"design {CHAIN} --at 0.3 --save {{run}}/scenario.toml", "scenario.toml: read a file that exists, wanted a"),
    ],
)
def test_what_cannot_be_used_is_refused_before_the_work(
    arguments: str, wanted: str, run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert wanted in complaint(monkeypatch, capsys, *arguments.format(run=run).split())


@pytest.mark.parametrize("options", ["--front", "--at 0.3", "--front --method graph-dk"])
def test_a_method_that_cannot_search_for_delays_is_refused(
    options: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (FOLDER / "chain3_bidirectional.toml").read_text(encoding="utf-8")
    file = tmp_path / "dk.toml"
    file.write_text(text if "--method" in options else text.replace('"graph-lqr"', '"graph-dk"'), encoding="utf-8")
    line = complaint(monkeypatch, capsys, "design", str(file), *options.split())
    assert "read method graph-dk, wanted --method inclusion or graph-lqr, with --front or --at" in line


@pytest.mark.parametrize(
    "command", ["fly", "fly --virtual", "check", "design", "stress --onset", "compare", "capacity"]
)
def test_what_is_no_scenario_is_named_in_plain_words(
    command: str, tmp_path: Path, run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    empty, binary = tmp_path / "empty.toml", tmp_path / "binary.toml"
    empty.write_text("\n")
    binary.write_bytes(b"\x7fELF\xff\xfe")
    said = {
        tmp_path: "read a folder, wanted a scenario file (see gcs new)",
        run: f"read a folder, wanted a scenario file, such as {run}/scenario.toml",
        empty: "read an empty file, wanted a scenario file (see gcs new)",
        binary: "read bytes that are not UTF-8 text, wanted a scenario file (see gcs new)",
    }
    for path, words in said.items():
        assert complaint(monkeypatch, capsys, *command.split(), str(path)) == f"{path}: {words}\n"


def test_a_folder_does_not_hide_a_shipped_scenarios_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "chain3").mkdir()
    monkeypatch.chdir(tmp_path)
    assert located("chain3").parent == FOLDER


DAMAGED = {
    "half a JSON file": b'{"delay_margin_s": 0.3,',
    "another JSON": b"[1, 2]",
    "a word for a number": b'{"delay_margin_s": "x", "delay_margin_continuous_s": 1.0}\n',
    "bytes": bytes(range(256)) * 40,
    "nothing": b"",
}


@pytest.mark.parametrize(
    ("name", "what"),
    [
        *itertools.product([DESIGN_FILE, PARQUET_FILE, SCENARIO_FILE], DAMAGED),
        # in these growing files, less than a whole line or row is not damage
        *itertools.product([EVENTS_FILE], ["a word for a number", "bytes"]),
        (TICKS_FILE, "bytes"),
    ],
)
def test_a_damaged_file_of_a_run_is_named_by_recover(
    name: str, what: str, run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    finish(run)
    (run / name).write_bytes(DAMAGED[what])
    assert f"run/{name}: " in complaint(monkeypatch, capsys, "recover", str(run))
    (run / name).unlink()
    (run / name).mkdir()
    assert f"run/{name}: " in complaint(monkeypatch, capsys, "recover", str(run))


@pytest.mark.parametrize("what", DAMAGED)
@pytest.mark.parametrize("name", [DESIGN_FILE, SUMMARY_FILE])
def test_a_damaged_file_of_a_run_is_named_by_replay(
    name: str, what: str, run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    finish(run)
    (run / name).write_bytes(DAMAGED[what])
    assert f"run/{name}: " in complaint(monkeypatch, capsys, "replay", str(run))


@pytest.mark.parametrize("what", DAMAGED)
def test_replay_and_monitor_name_a_design_they_cannot_read(
    what: str, run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    design = run / "other.json"
    design.write_bytes(DAMAGED[what])
    for command in (("replay", str(run)), ("monitor", "--listen", "127.0.0.1:0")):
        assert "run/other.json: " in complaint(monkeypatch, capsys, *command, "--design", str(design))


@pytest.mark.parametrize("what", ["bytes", "nothing", "another JSON", "of no kind", "a folder", "not there"])
def test_an_unreadable_truth_log_is_named_by_grade(
    what: str, run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if what == "a folder":
        (run / TRUTH_FILE).mkdir()
    elif what != "not there":
        (run / TRUTH_FILE).write_bytes(b"UAVTRUE2" + bytes(400) if what == "of no kind" else DAMAGED[what])
    assert TRUTH_FILE in complaint(monkeypatch, capsys, "grade", str(run))


def test_ticks_of_unknown_vehicles_are_refused(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (run / SCENARIO_FILE).read_text(encoding="utf-8")
    (run / SCENARIO_FILE).write_text(text.replace("system_id = 1\n", "system_id = 9\n"), encoding="utf-8")
    assert "read ticks of vehicles [1]" in complaint(monkeypatch, capsys, "recover", str(run))


@pytest.mark.parametrize(("listens", "mirror"), [("127.0.0.1", "localhost"), ("0.0.0.0", "127.0.0.1")])
def test_a_mirror_to_the_stations_own_port_is_refused(listens: str, mirror: str) -> None:
    with listening("--listen", f"{listens}:0") as link, pytest.raises(InputError, match="which is this station's own"):
        mirroring(f"{mirror}:{link.address[1]}", link, commands=False)


def test_a_picture_is_a_png_within_the_recording(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusal(*options: str) -> str:
        return complaint(monkeypatch, capsys, "view", str(run), *options)

    finish(run)
    record_run(run)
    assert "a.jpg, wanted a name that ends in .png" in refusal("--picture", str(run / "a.jpg"))
    line = refusal("--picture", str(run / "a.png"), "--at", "999")
    assert "--at: read 999, wanted seconds from 0: " in line
    assert line.endswith(f"is {0.02 * 99:g} s long\n")
    (run / "flight.rrd").write_bytes((run / "flight.rrd").read_bytes()[:5000])
    assert "flight.rrd: read no flight in it, wanted" in refusal("--picture", str(run / "a.png"))
    assert not list(run.glob("a.*"))


def test_brackets_and_colons_in_text_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """A verdict's reason can name a key of a scenario; a folder may have any name, a vehicle send any text."""
    scenario = line(2)
    summary = summarise(scenario, DESIGN, ticks_of(scenario, start_s=0.0, count=100).ravel(), [])
    reason = "refused: give [response] in [/the scenario] :warning:"
    print_summary(summary.model_copy(update={"reason": reason}), Path("[bold]"))
    printed = capsys.readouterr().out
    assert "verdict  aborted: refused: give [response] in [/the scenario] :warning:\n" in printed
    assert "files    [bold]: " in printed


def test_an_empty_connect_does_not_start_vehicles(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "--connect: read '', wanted HOST:PORT" in complaint(monkeypatch, capsys, "fly", CHAIN, "--connect", "")


def test_a_name_too_long_for_a_file_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "File name too long, wanted" in complaint(monkeypatch, capsys, "view", "a" * 300)
