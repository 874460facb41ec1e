"""The documentation says what the code does: generated parts, figures, commands, links."""

import contextlib
import dataclasses
import doctest
import re
import select
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from docs.generate import blocks, measurements, reference
from docs.generate.keys import keys_page, schema
from docs.generate.measurements import FIGURES
from docs.generate.reference import described, found_fields
from docs.generate.runner import CommandError, Runner
from docs.generate.sessions import Step, steps_of
from gcs.cli.margin import margin_fields, margin_of_file, margin_of_scenario
from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.plan.criteria import with_bounds
from gcs.plan.design import Design, GainsAtDelay, LinkPart
from gcs.plan.disturbed import with_spread
from gcs.plan.planner import flight_plan, over_own_links, with_trade_off
from gcs.runs.files import write_design
from gcs.runs.record import SCENARIO_FILE, RunWriter
from gcs.runs.summary import finish
from gcs.station.station import Station
from gcs.stress.trial import Outcome
from gcs.studies.virtual import fly_virtual
from scenarios import files
from scenarios.keys.criteria import Criteria
from scenarios.keys.disturbance import Navigation
from scenarios.keys.link import Link, Links, VehicleLinks
from scenarios.schema import FixedGains, Response
from tests.support.fleets.own_code import coded

ROOT = blocks.ROOT
PAGES = {str(page.relative_to(ROOT)): page for page in blocks.pages()}
SESSIONS = [name for name, page in PAGES.items() if any(_ for _ in steps_of(page))]
FLOWN_S = 15.0
"""The pages' scenarios are shortened to this, so that their commands can be typed as they stand."""


def test_the_reference_and_the_schema_match_the_code() -> None:
    assert reference.stale() == [], "python3 make.py reference"


@pytest.mark.parametrize("name", [name for name, figure in FIGURES.items() if figure.kind == "quick"])
def test_quick_exact_figures_are_those_that_the_commands_give(name: str) -> None:
    assert measurements.stale([name]) == [], f"python3 make.py measurements {name}"


def test_a_figure_that_was_changed_by_hand_is_noticed() -> None:
    [page] = blocks.pages_with("margin-held")
    text = blocks.blocks_of(page)["margin-held"]
    other_day = re.sub(r"Measured on [\d-]+", "Measured on 2001-01-01", text)
    assert other_day != text
    assert blocks.differing("margin-held", other_day) == []
    assert blocks.differing("margin-held", text.replace("1.72941", "1.72942")) == [page]


def test_generated_blocks_have_a_maker_and_figures_a_page() -> None:
    known = {*reference.MAKERS, *FIGURES, *(f"{name}-bare" for name in FIGURES)}
    assert {name for page in PAGES.values() for name in blocks.blocks_of(page)} <= known
    assert measurements.unused() == []


def test_the_readme_is_short() -> None:
    assert len(PAGES["README.md"].read_text(encoding="utf-8").splitlines()) <= 120


def test_names_of_tests_have_at_most_ten_words() -> None:
    names = [
        name for file in (ROOT / "tests").rglob("*.py") for name in re.findall(r"def test_(\w+)", file.read_text())
    ]
    assert [name for name in names if name.count("_") >= 10] == []


def test_every_scenario_key_has_a_description() -> None:
    whole = schema()
    parts = {"Scenario": whole, **whole["$defs"]}
    missing = [
        f"{name}.{key}"
        for name, part in parts.items()
        for key, value in part["properties"].items()
        if not value.get("description")
    ]
    assert missing == []


@pytest.mark.parametrize("file", sorted((ROOT / "scenarios").glob("*.toml")), ids=lambda file: file.stem)
def test_scenarios_name_the_schema(file: Path) -> None:
    assert file.read_text(encoding="utf-8").splitlines()[0] == "#:schema ./scenario.schema.json"


def fly(folder: Path, name: str, **changes: Any) -> dict[str, Any]:
    """The summary of a short flight in virtual time."""
    scenario = files.load(ROOT / "scenarios" / f"{name}.toml").model_copy(update={"duration_s": 2.0} | changes)
    design, plan = flight_plan(scenario)
    (folder / SCENARIO_FILE).write_text(files.dump(scenario), encoding="utf-8")
    write_design(folder, design)
    station, writer = Station(plan, start_ns=START_NS), RunWriter(folder)
    for rows in fly_lockstep(plan, station=station):
        writer.tick(rows)
    for event in station.events:
        writer.event(event)
    writer.close()
    return finish(folder).to_dict()


def test_every_field_of_a_summary_is_described_and_no_other(tmp_path: Path) -> None:
    known = described()["summary"]
    own = fly_virtual(coded(law="soft"), allow_code=True).summary.to_dict()
    assert found_fields(fly(tmp_path, "chain3"), known) | found_fields(own, known) == known.keys()


def test_every_field_of_a_design_is_described_and_no_other() -> None:
    known = described()["design"]
    load = {name: files.load(ROOT / "scenarios" / f"{name}.toml") for name in ("chain3", "copters5")}
    load["two way"] = files.load(ROOT / "scenarios" / "chain3_bidirectional.toml")
    load["onboard"] = files.with_loop(load["chain3"], "onboard", Path("chain3.toml"))
    load["copters5"] = load["copters5"].model_copy(update={"response": Response(lag_s=0.15)})
    predicted = load["chain3"].control.model_copy(update={"prediction": 0.6})
    load["predicted"] = load["chain3"].model_copy(update={"control": predicted})
    fed = {"gains": FixedGains(K1=-3.4, K2=3.1, K3=5.6), "delay_margin_s": None, "feed_forward": 0.9}
    load["fed forward"] = load["chain3"].model_copy(update={"control": load["chain3"].control.model_copy(update=fed)})
    load["noisy"] = load["chain3"].model_copy(update={"navigation": Navigation(position_noise_m=1.0)})
    varying = load["chain3"].control.model_copy(update={"criteria": Criteria(delays_s=(0.0, 0.1))})
    load["varying"] = load["chain3"].model_copy(update={"control": varying})
    load["own law"] = coded(law="soft")
    slow = Link(delay_s=0.12)
    unlike = Links(up=Link(delay_s=0.02), down=slow, vehicles=(VehicleLinks(system_id=3, up=slow),))
    load["two way"] = load["two way"].model_copy(update={"links": unlike})
    planned = (over_own_links(*flight_plan(scenario)) for scenario in load.values())
    designs = [with_bounds(with_spread(design, plan), plan.scenario) for design, plan in planned]
    designs[0] = with_trade_off(designs[0])
    link = LinkPart(
        source="runs/log", vehicles=(1,), loop_delay_s_least=0.1, loop_delay_s_p50=0.2, loop_delay_s_worst=0.3,
        headroom=0.3, lost_share=0.2, maximised="alpha", chosen="", candidates=(GainsAtDelay(prediction=True),),
    )  # fmt: skip
    found = [found_fields(design.to_dict(), known) for design in (*designs, Design(delay_margin_s=1.0, for_link=link))]
    assert set[str]().union(*found) == known.keys()


def test_every_field_of_a_margin_is_described_and_no_other(tmp_path: Path) -> None:
    known = described()["margin"]
    numbers = tmp_path / "numbers.json"
    numbers.write_text('{"terms": [{"A": [[0]], "delay": 0}, {"A": [[-1]], "delay": 0.1}]}', encoding="utf-8")
    models = [margin_of_file(file) for file in (numbers, *sorted((ROOT / "docs" / "models").glob("*.json")))]
    predicted = tmp_path / "predicted.toml"
    text = (ROOT / "scenarios" / "chain3.toml").read_text(encoding="utf-8")
    predicted.write_text(text.replace("[control]", "[control]\nprediction = 0.6"), encoding="utf-8")
    thesis = (ROOT / "scenarios" / f"thesis_{loop}.toml" for loop in ("delay", "gains"))
    scenarios = (margin_of_scenario(file) for file in (*thesis, predicted))
    results = [*models, *scenarios]
    assert set[str]().union(*(found_fields(margin_fields(result), known) for result in results)) == known.keys()


def test_every_field_of_a_trial_is_described_and_no_other() -> None:
    assert [field.name for field in dataclasses.fields(Outcome)] == list(described()["trial"])


def shell(steps: list[Step], folder: Path) -> None:
    """Run the steps of a session; each command must end with the exit code that its page states."""
    session: dict[str, Any] = {}
    servers: list[subprocess.Popen[bytes]] = []
    try:
        for step in steps:
            if step.file:
                with (folder / step.file).open("a" if step.append else "w", encoding="utf-8") as file:
                    file.write(("\n" if step.append else "") + step.text)
            elif step.python:
                python(step.text, session)
            elif step.server:
                servers.append(server(step.text.split(), folder))
            else:
                for command in step.text.strip().splitlines():
                    Runner(folder).run(command, wanted=(step.exit_code,))
    finally:
        for each in servers:
            each.terminate()
            each.communicate()


def server(command: list[str], folder: Path) -> subprocess.Popen[bytes]:
    """Start a program that keeps running, and wait for its first line of output."""
    program = Path(sys.executable).with_name(command[0])
    started = subprocess.Popen([program, *command[1:]], cwd=folder, stdout=subprocess.PIPE)
    assert started.stdout is not None
    assert started.stdout.readline()
    return started


def python(text: str, session: dict[str, Any]) -> None:
    test = doctest.DocTestParser().get_doctest(text, session, "page", None, 0)
    report: list[str] = []
    assert doctest.DocTestRunner(verbose=False).run(test, out=report.append, clear_globs=False).failed == 0, report
    session |= test.globs


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder laid out like the repository, with scenarios shortened to `FLOWN_S`."""
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    shutil.copytree(ROOT / "scenarios", tmp_path / "scenarios", ignore=shutil.ignore_patterns("*.py*", "__pycache__"))
    for file in (tmp_path / "scenarios").glob("*.toml"):
        text = file.read_text(encoding="utf-8")
        wanted_s = min(FLOWN_S, files.load(file).duration_s)
        file.write_text(re.sub(r"^duration_s = [\d.]+", f"duration_s = {wanted_s}", text, flags=re.M), encoding="utf-8")
    return tmp_path


# the README's command in virtual time belongs to a figure, which is compared above
@pytest.mark.parametrize("name", [name for name in SESSIONS if name != "README.md"])
def test_what_a_page_says_to_type_works(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    shell([step for step in steps_of(PAGES[name]) if not step.realtime], folder)


@pytest.mark.realtime
@pytest.mark.xdist_group("documentation")
@pytest.mark.parametrize("name", [n for n in SESSIONS if any(step.realtime for step in steps_of(PAGES[n]))])
def test_what_a_page_says_to_type_works_in_real_time(name: str, folder: Path) -> None:
    steps = [step for step in steps_of(PAGES[name]) if step.realtime or step.file or "gcs key" in step.text]
    for tries_left in reversed(range(20)):
        try:
            shell(steps, folder)
            return
        except CommandError as error:  # the pages use the default port, which another test may hold for a moment
            if "Address already in use" not in str(error) or not tries_left:
                raise
            wait_until_free(14550)
            for made in (folder / "runs", *folder.glob("*.key")):  # commands refuse to overwrite these
                shutil.rmtree(made) if made.is_dir() else made.unlink(missing_ok=True)


def wait_until_free(port: int) -> None:
    """Wait until no process on this machine listens on a UDP port."""
    for _ in range(600):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return
        select.select([], [], [], 0.1)


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_to_pages_that_exist(name: str) -> None:
    page = PAGES[name]
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = [target.partition("#") for target in re.findall(r"\]\(([^)\s]+)\)", text)]
    broken = [
        f"{target}#{anchor}"
        for target, _, anchor in targets
        if not (file := (page.parent / target if target else page)).exists() or (anchor and anchor not in anchors(file))
    ]
    assert broken == []


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as Markdown renderers make them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


@pytest.mark.parametrize(
    ("key", "unit", "value"),
    [
        ("jerk_max_m_s3", "m/s³", "number"),
        ("drag_1_m", "1/m", "number"),
        ("spacing_gain_max_s2", "s²", "number"),
        ("wind_ne_m_s2", "m/s², north and east", "2 numbers"),
        ("queue_bytes", "bytes", "whole number"),
        ("waypoints_ne_m", "m, north and east", "rows of 2 numbers"),
        ("gain", "", "2 rows of numbers"),
    ],
)
def test_keys_are_listed_with_their_unit_and_kind_of_value(key: str, unit: str, value: str) -> None:
    assert f"| `{key}` | {unit} | {value} |" in keys_page()
