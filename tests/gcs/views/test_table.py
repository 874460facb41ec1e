"""The live table says what is known, fits its place, and is as useful without a terminal."""

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from gcs.control.tick import Event, Mode, TickArray
from gcs.link.startup import WITHOUT_TARGET
from gcs.views.table import FlightState, plain_line, render
from scenarios.schema import Scenario
from tests.support.fleets.flown_run import DESIGN, line, ticks_of


def drawn(state: FlightState, *, width: int = 120, height: int = 40) -> list[str]:
    """The lines of the table on a terminal of this size."""
    console = Console(file=io.StringIO(), width=width, height=height, color_system=None, legacy_windows=False)
    with console.capture() as capture:
        console.print(render(state, width=width, height=height))
    return [text.rstrip() for text in capture.get().rstrip("\n").split("\n")]


def row_of(lines: list[str], system_id: int) -> list[str]:
    [row] = [cells for text in lines if (cells := text.split()) and cells[0] == str(system_id)]
    return row


def flown(scenario: Scenario, ticks: TickArray | None = None) -> FlightState:
    """The state after a second of flight, or after these ticks."""
    state = FlightState(scenario, DESIGN)
    state.add(ticks_of(scenario, start_s=0.0, count=50) if ticks is None else ticks, [])
    return state


def test_a_row_shows_the_newest_state_and_recent_figures() -> None:
    ticks = ticks_of(line(5), start_s=10.0, count=50)
    ticks["spacing_error_north_m"][-1, 1], ticks["spacing_error_east_m"][-1, 1] = 3.0, 4.0
    ticks["loop_delay_s"][:, 1] = np.linspace(0.051, 0.100, 50)
    ticks["headroom"][:, 1] = 0.9
    ticks["headroom"][7, 1] = 0.25
    ticks["rtt_s"][-3:, 1] = [np.nan, 0.0612, np.nan]
    ticks["lost"][-1, 1], ticks["late"][-1, 1] = 17, 4
    row = row_of(drawn(flown(line(5), ticks)), 4)
    assert row == ["4", "5", "5.00", "10.0", "61.2", "76.0", "100.0", "400", "25", "██▌", "17", "4", "NOMINAL"]


def test_the_figures_forget_what_was_before_the_last_seconds() -> None:
    ticks = ticks_of(line(2), start_s=0.0, count=400)
    ticks["headroom"][:100, 1] = 0.1
    ticks["headroom"][100:, 1] = 0.8
    state = flown(line(2), ticks[:150])
    assert row_of(drawn(state), 1)[8] == "10"
    state.add(ticks[150:], [])  # 6 s later
    assert row_of(drawn(state), 1)[8] == "80"


def test_at_the_end_figures_are_those_of_the_last_commands() -> None:
    """Vehicles that hold are back at the fastest gains, but nothing is flown with their headroom."""
    ticks = ticks_of(line(2), start_s=0.0, count=60)
    ticks["commanded"][:50], ticks["gain_set"][:50], ticks["headroom"][:50] = True, 1, 0.4
    ticks["headroom"][50:] = -0.5
    figures = flown(line(2), ticks).figures()
    assert (figures.gain_set, figures.headroom.tolist()) == (1, [0.4, 0.4])


def test_a_long_silence_after_the_flight_leaves_its_figures() -> None:
    """A vehicle that does not confirm that it holds is waited for, longer than the figures' window."""
    ticks = ticks_of(line(2), start_s=0.0, count=450)
    ticks["commanded"][:100], ticks["headroom"][:100] = True, 0.4
    ticks["headroom"][100:] = -20.0
    state = flown(line(2), ticks[:100])
    for part in np.array_split(ticks[100:], 10):
        state.add(part, [])
    assert state.figures().headroom.tolist() == [0.4, 0.4]
    assert (state.time_s, state.skipped) == (ticks["time_s"][-1, 0], 0)


def test_the_gain_set_of_a_lost_vehicle_is_not_flown() -> None:
    ticks = ticks_of(line(3), start_s=0.0, count=50)
    ticks["commanded"][:, :2], ticks["gain_set"][:, 2] = True, 1
    assert flown(line(3), ticks).figures().gain_set == 0


def test_the_age_of_a_lost_vehicle_is_no_loop_delay() -> None:
    ticks = ticks_of(line(3), start_s=0.0, count=50)
    ticks["loop_delay_s"], ticks["headroom"] = 0.05, 0.8
    ticks["loop_delay_s"][:, 2], ticks["headroom"][:, 2], ticks["mode"][:, 2] = 9.0, -8.0, Mode.LOST
    text = plain_line(flown(line(3), ticks))
    assert "loop delay p99 max 50.0 ms  headroom min 80 %" in text
    assert "LOST 1" in text


def test_what_is_unknown_is_a_dash_and_never_a_zero() -> None:
    lines = drawn(FlightState(line(3), DESIGN))
    for system_id, front in ((3, "–"), (2, "3"), (1, "2")):
        assert row_of(lines, system_id) == [str(system_id), front, *"–––––––", "0", "0", "WAITING"]
    assert any("least headroom –" in text and "lateness p99 – ms" in text for text in lines)


def test_a_leader_has_no_spacing_error() -> None:
    assert row_of(drawn(flown(line(3))), 3)[:4] == ["3", "–", "–", "–"]


@pytest.mark.parametrize("count", [1, 20, 250, 1000])
@pytest.mark.parametrize(("width", "height"), [(40, 20), (60, 20), (80, 24), (100, 30), (120, 40), (200, 60)])
def test_the_table_fits_every_terminal(count: int, width: int, height: int) -> None:
    state = flown(line(count))
    words = "a long word about something that happened somewhere " * 5
    state.add(
        ticks_of(line(count), start_s=5.0, count=1),
        [Event(time_s=1.0 * k, kind="statustext", system_id=1, text=words) for k in range(9)],
    )
    lines = drawn(state, width=width, height=height)
    assert len(lines) <= height
    assert max(len(text) for text in lines) <= width
    assert "NOMINAL" in "".join(lines)  # the last column is whole


def test_forty_rows_show_all_twenty_vehicles_in_the_scenarios_order() -> None:
    lines = drawn(flown(line(20)))
    shown = [int(text.split()[0]) for text in lines if text.endswith("NOMINAL")]
    assert shown == list(range(20, 0, -1))
    assert not any("not shown" in text for text in lines)


def test_of_many_vehicles_the_worst_are_shown_and_others_counted() -> None:
    ticks = ticks_of(line(250), start_s=0.0, count=5)
    ticks["mode"][-1, 100] = Mode.LOST  # system id 150
    ticks["headroom"][-1, 200] = -0.2  # system id 50
    lines = drawn(flown(line(250), ticks))
    shown = [text for text in lines if text.endswith(("NOMINAL", "LOST"))]
    assert row_of(shown, 150)[-1] == "LOST"
    assert row_of(shown, 50)[8] == "-20"
    [note] = [text for text in lines if "not shown" in text]
    assert int(note.split()[1]) + len(shown) == 250
    assert len(shown) >= 25


def test_header_and_footer_say_phase_time_progress_lateness_and_skips() -> None:
    scenario = line(3)
    ticks = ticks_of(scenario, start_s=0.0, count=251)
    ticks["sent_ns"] = ticks["due_ns"] + 2_500_000
    ticks["headroom"][-1, 1] = 0.123
    state = FlightState(scenario, DESIGN)
    state.add(np.delete(ticks, [30, 31], axis=0), [Event(time_s=0, kind="phase", system_id=None, text="flying")])
    text = "\n".join(drawn(state))
    for wanted in (
        "line3  flying  5.0 s",
        "delay margin 400 ms (ground loop, fastest gains)",
        "15.0 s of 20.0 s left",
        "least headroom 12 % (vehicle 2)",
        "tick lateness p99 2.50 ms",
        "2 ticks skipped",
        "0.00 s  phase  flying",
    ):
        assert wanted in text


def test_events_saying_the_same_of_several_vehicles_share_a_line() -> None:
    state = FlightState(line(20), DESIGN)
    late = [Event(time_s=3.1, kind="mode", system_id=k, text="NOMINAL -> CAUTION") for k in range(1, 21)]
    back = [Event(time_s=9.0, kind="mode", system_id=7, text="CAUTION -> NOMINAL")]
    state.add(ticks_of(line(20), start_s=0.0, count=1), [*late[:5], *back])
    assert [text.split("  mode  ")[1] for text in state.news] == [
        "vehicles 1 2 3 4 5: NOMINAL -> CAUTION",
        "vehicle 7: CAUTION -> NOMINAL",
    ]
    state.add(ticks_of(line(20), start_s=0.0, count=1), late)
    assert state.news[-1].endswith("vehicles 1 2 3 4 5 6 7 8 9 10 11 12 and 8 more: NOMINAL -> CAUTION")


def test_a_plain_line_has_the_worst_of_the_formation() -> None:
    ticks = ticks_of(line(5), start_s=2.0, count=50)
    ticks["spacing_error_north_m"][-1, 3], ticks["spacing_error_east_m"][-1, 3] = 30.0, 40.0
    ticks["loop_delay_s"][:, 2] = 0.35
    ticks["headroom"][:, 2] = 0.125
    ticks["mode"][-1, [2, 3]] = Mode.CAUTION
    ticks["mode"][-1, 4] = Mode.LOST
    assert plain_line(flown(line(5), ticks)).split("  ") == [
        *("", "", "2.98 s"),
        "spacing error max 50.00 m",
        "loop delay p99 max 350.0 ms",
        "headroom min 12 % (vehicle 3)",
        "LOST 1, CAUTION 3 2",
    ]


def test_before_the_flight_times_count_from_the_stations_start() -> None:
    state = FlightState(line(2), DESIGN)
    found = Event(time_s=-19.5, kind="vehicle", system_id=2, text="found")
    state.add(ticks_of(line(2), start_s=-20.0, count=51), [found])
    assert plain_line(state).startswith("start +1.00 s  spacing")
    assert state.news == ["start +0.50 s  vehicle 2: found"]
    assert "start +1.00 s" in drawn(state)[0]


def test_a_plain_line_before_anything_is_known_says_so() -> None:
    text = plain_line(FlightState(line(2), DESIGN))
    assert "spacing error max – m" in text
    assert text.endswith("headroom min –  WAITING 2 1")


@pytest.mark.parametrize(
    ("mode", "headroom", "sequences"),
    [(Mode.NOMINAL, 0.8, ["\x1b[32m"]), (Mode.CRITICAL, -0.1, ["\x1b[1;31m"]), (Mode.CAUTION, 0.2, ["\x1b[33m"])],
)
def test_headroom_is_coloured_on_a_terminal_only(mode: Mode, headroom: float, sequences: list[str]) -> None:
    ticks = ticks_of(line(2), start_s=0.0, count=1)
    ticks["mode"], ticks["headroom"] = mode, headroom
    picture = render(flown(line(2), ticks), width=120, height=40)
    for terminal in (True, False):
        output = io.StringIO()
        Console(file=output, width=120, force_terminal=terminal, color_system="standard" if terminal else "auto").print(
            picture
        )
        assert all((sequence in output.getvalue()) == terminal for sequence in sequences)


def test_refusals_have_their_own_line_and_are_no_news() -> None:
    state = flown(line(2))
    event = Event(time_s=1.0, kind="refused", text="3 unsigned", counts={"unsigned": 3})
    assert not any("refused" in text for text in drawn(state))
    state.add(ticks_of(line(2), start_s=1.0, count=1), [event, replace(event, text="5 unsigned, 1 replayed")])
    assert [text for text in drawn(state) if "refused" in text] == ["refused: 5 unsigned, 1 replayed"]
    assert state.news == []


def test_vehicles_that_do_not_report_their_active_target_are_named() -> None:
    level = line(2)
    state = flown(level.model_copy(update={"control": level.control.model_copy(update={"prediction": "measured"})}))
    assert next(text for text in drawn(state) if "assumed:" in text).endswith("acts as it was sent")
    refusal = Event(time_s=-19.5, kind="vehicle", system_id=2, text=WITHOUT_TARGET)
    state.add(ticks_of(level, start_s=1.0, count=1), [refusal])
    assert next(text for text in drawn(state) if "assumed:" in text).endswith("acts as it was sent: vehicle 2")


def test_altitudes_are_shown_where_vehicles_fly_at_several() -> None:
    level = line(2)
    slots = level.model_copy(
        update={"vehicles": (level.vehicles[0], level.vehicles[1].model_copy(update={"altitude_m": 315.0}))}
    )
    ticks = ticks_of(slots, start_s=0.0, count=50)
    ticks["down_m"][-1] = [-300.25, -315.0]
    lines = drawn(flown(slots, ticks))
    assert "altitude" in " ".join(lines)
    assert {"300.2", "315.0"} <= {cell for text in lines for cell in text.split()}
    assert "altitude" not in " ".join(drawn(flown(level)))
