"""Found before take-off, in one line with exit code 2: unstable loops, bad starts, links too slow for a flight."""

import itertools
import json
from math import hypot
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gcs.cli.main import app
from gcs.plan.planner import flight_plan
from gcs.preflight.faults import bad_start, endless_link, unstable_loop, without_actions
from gcs.runs.summary import summarise
from scenarios.files import load
from scenarios.keys.link import DelayPoint, Link, Links
from tests.support.commands import complaint
from tests.support.paths import ROOT

CHAIN = load(ROOT / "scenarios/chain3.toml")


def chain_file(folder: Path, *changes: tuple[str, str]) -> Path:
    """chain3.toml with pieces of its text replaced."""
    text = (ROOT / "scenarios/chain3.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    file = folder / "chain3.toml"
    file.write_text(text, encoding="utf-8")
    return file


def line_of_vehicle(file: Path, system_id: int) -> int:
    """The line of a vehicle's position."""
    lines = file.read_text(encoding="utf-8").splitlines()
    after = lines.index(f"system_id = {system_id}")
    return next(k for k, text in enumerate(lines, 1) if k > after and text.startswith("position_ne_m"))


def with_gains(folder: Path, K1: float, K2: float, K3: float) -> Path:
    return chain_file(folder, ("delay_margin_s = 0.3", f"gains = {{K1 = {K1!r}, K2 = {K2!r}, K3 = {K3!r}}}"))


@pytest.mark.parametrize(
    "command", [("design",), ("fly", "--virtual"), ("stress", "--onset"), ("design", "--loop", "onboard")]
)
@pytest.mark.parametrize(
    ("gains", "wanted"),
    [
        ((3.0, 0.6, 5.6), "without any delay: root +3 1/s, vehicle 1;"),
        # s² + k1 s + k3 of each follower: roots +0.5 ± √(0.25 − 4) j
        ((1.0, 0.0, 4.0), "without any delay: root +1 1/s, vehicle 1;"),
        # (s² + 3 s − 4) = (s + 4)(s − 1)
        ((-3.0, 0.6, -4.0), "without any delay: root +1 1/s, vehicle 2;"),
        ((-3.0, 0.6, 0.0), "without any delay: root +0 1/s, vehicle 2;"),
        # 1 − 300 T is −5 at 50 Hz and −2 at the 100 Hz on board
        ((-300.0, 0.0, 1.0), "only sampling makes unstable"),
    ],
)
def test_an_unstable_loop_is_refused_with_its_root(
    command: tuple[str, ...],
    gains: tuple[float, float, float],
    wanted: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = with_gains(tmp_path, *gains)
    line = complaint(monkeypatch, capsys, command[0], str(file), *command[1:])
    number = file.read_text(encoding="utf-8")[: file.read_text(encoding="utf-8").index("gains = ")].count("\n") + 1
    assert line.startswith(f"{file}: line {number}: control.gains: read a loop that ")
    assert wanted in line


def test_an_unstable_coupled_loop_of_a_pattern_names_all_vehicles() -> None:
    scenario = load(ROOT / "scenarios/thesis_gains.toml")
    blocks = tuple(
        block.model_copy(update={"gain": tuple(tuple(-value for value in row) for row in block.gain)})
        for block in scenario.control.blocks
    )
    control = scenario.control.model_copy(update={"blocks": blocks})
    line = unstable_loop(flight_plan(scenario.model_copy(update={"control": control}))[1])
    assert line is not None
    assert line.startswith("control.blocks: ")
    assert "vehicles 1 2 3;" in line


def test_a_stable_loop_beyond_its_margin_is_flown() -> None:
    late = CHAIN.with_link_delay(up_s=0.4, down_s=0.4)
    assert unstable_loop(flight_plan(late)[1]) is None
    assert endless_link(late) is None
    assert bad_start(late) is None


def test_an_unstable_loop_that_is_flown_shows_no_headroom(tmp_path: Path) -> None:
    from gcs.drive.flown import fly_plan

    designed, plan = flight_plan(load(with_gains(tmp_path, 3.0, 0.6, 5.6)))
    flight = fly_plan(without_actions(plan))
    summary = summarise(plan.scenario, designed, flight.ticks, flight.events)
    assert summary.verdict == "unstable"
    assert summary.headroom_min is None
    assert not (flight.ticks["headroom"] == -float("inf")).any()
    assert not [event for event in flight.events if event.kind == "gains"]


@pytest.mark.slow(first=3)
@pytest.mark.parametrize("gains", list(itertools.product((-1e5, 1e5), repeat=3)))
def test_gains_of_any_size_are_assessed_and_reported(gains: tuple[float, float, float], tmp_path: Path) -> None:
    file = with_gains(tmp_path, *gains)
    printed = CliRunner().invoke(app, ["design", str(file), "--allow-unstable"])
    assert printed.exit_code == 0, printed.output
    assert "none: the sampled loop is unstable without any delay" in printed.output
    as_json = CliRunner().invoke(app, ["design", str(file), "--allow-unstable", "--json"])
    assert json.loads(as_json.stdout)["delay_margin_s"] == 0.0


def test_starts_in_collision_or_past_the_limit_are_found_beforehand(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    near = chain_file(tmp_path, ("[-242.79, 243.09]", "[-122.82, 125.52]"))
    for command in (("fly", "--virtual"), ("stress", "--onset"), ("bench",), ("compare",)):
        line = complaint(monkeypatch, capsys, command[0], str(near), *command[1:])
        assert "read vehicles 2 and 3 3 m apart, wanted at least safety.collision_distance_m = 5 m" in line
        assert line.startswith(f"{near}: line {line_of_vehicle(near, 3)}: vehicle 3: position_ne_m: ")
    assert flight_plan(load(near))[1].delay_margin_s > 0.29  # designed all the same
    far = chain_file(tmp_path, ("[-242.79, 243.09]", "[-2242.79, 243.09]"))
    assert "vehicle 3: position_ne_m: read a spacing error of 1998" in complaint(
        monkeypatch, capsys, "fly", str(far), "--virtual"
    )


def test_a_link_too_slow_for_the_flight_is_found_beforehand(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = str(ROOT / "scenarios/chain3.toml")
    line = complaint(monkeypatch, capsys, "fly", file, "--virtual", "--link-delay", "40")
    assert line == (
        f"{file}: links: read a round trip of 80 s to vehicle 1, wanted less than the 20 s that the station "
        "waits for an answer\n"
    )
    out = str(tmp_path / "stress")
    line = complaint(monkeypatch, capsys, "stress", file, "--delay", "0.1,30", "--out", out)
    assert "read a round trip of 30 s to vehicle 1" in line
    assert not (tmp_path / "stress").exists()
    late = str(chain_file(tmp_path, ("delay_s = 0.02", "delay_s = 40.0")))
    for command in ("bench", "compare", "capacity"):
        assert "read a round trip of 80 s to vehicle 1" in complaint(monkeypatch, capsys, command, late)
    number = Path(late).read_text(encoding="utf-8").splitlines().index("[links]") + 1
    assert complaint(monkeypatch, capsys, "check", late).startswith(f"{late}: line {number}: links: read a round trip")
    assert endless_link(CHAIN.with_link_delay(up_s=9.9, down_s=9.9)) is None
    short = CHAIN.with_link_delay(up_s=3.0, down_s=3.0).model_copy(update={"duration_s": 6.0})
    assert "wanted less than duration_s = 6 s" in (endless_link(short) or "")
    # slow at first and fast before the end: commands do act
    ramp = Link(delay_points=(DelayPoint(at_s=0.0, delay_s=4.0), DelayPoint(at_s=1.0, delay_s=0.0)))
    assert endless_link(short.model_copy(update={"links": Links(up=ramp, down=ramp)})) is None


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        (
            [("up = { delay_s = 0.02 }", "up = { delay_s = 0.02, loss_probability = 1.0 }")],
            "read loss_probability 1 to",
        ),
        (
            [
                (
                    "up = { delay_s = 0.02 }",
                    'up = { delay_s = 0.02, jitter = { distribution = "uniform", scale_s = 60 } }',
                )
            ],
            "wanted less than the 20 s that the station waits",
        ),
    ],
)
def test_links_that_let_nothing_through_are_refused(
    changes: list[tuple[str, str]], wanted: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    file = str(chain_file(tmp_path, *changes))
    for command in (("check",), ("fly", "--virtual")):
        assert wanted in complaint(monkeypatch, capsys, *command, file)


def test_places_nearer_than_a_collision_are_refused() -> None:
    _, second, third = CHAIN.vehicles
    assert second.offset_ne_m is not None
    assert second.offset_ne_m == third.offset_ne_m
    wanted_m = hypot(*second.offset_ne_m)
    # the vehicles start farther apart than they are to fly
    apart = [
        vehicle.model_copy(update={"position_ne_m": (-(wanted_m + 10.0) * k, 0.0)})
        for k, vehicle in enumerate(CHAIN.vehicles)
    ]
    safety = CHAIN.safety.model_copy(update={"collision_distance_m": wanted_m + 5.0, "spacing_error_limit_m": 1e4})
    fault = bad_start(CHAIN.model_copy(update={"vehicles": tuple(apart), "safety": safety})) or ""
    assert fault.startswith("vehicle 2: offset_ne_m: read places of vehicles 1 and 2")
    assert f"wanted at least safety.collision_distance_m = {wanted_m + 5.0:g} m" in fault


def test_a_speed_that_simulated_copters_cannot_fly_is_refused() -> None:
    copters = load(ROOT / "scenarios/copters5.toml")
    assert bad_start(copters) is None
    [entry] = copters.nominal_velocity
    fast = copters.model_copy(update={"nominal_velocity": (entry.model_copy(update={"velocity_ne_m_s": (60.0, 0.0)}),)})
    wanted = "nominal_velocity: read 60 m/s, wanted at most autopilot.speed_max_m_s = 12 m/s"
    assert bad_start(fast) == wanted
