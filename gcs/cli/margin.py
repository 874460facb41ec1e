"""What `gcs margin` reads and prints: the delay margin of a JSON model or of a scenario's loop.

The mathematics is in `gains.margin.loop_margin`.
"""

from fractions import Fraction
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from gains.core.errors import BadModelError
from gains.margin.loop_margin import LoopAtGivenDelays, LoopMargin, MarginCrossing, as_known, loop_margin
from gains.margin.model_file import DelayModel, HeldModel, Term, parse_model

_ROWS = 20
"""Most rows of a table."""


class ModelFileError(BadModelError):
    """The model file cannot be used: one line with file, key, what was read and what was wanted."""


def margin_of_file(file: Path) -> dict[str, Any]:
    """The margin of a JSON model as plain types; an unbounded number is None.

    Raises
    ------
    ModelFileError
        One line with file, key, what was read and what was wanted.
    DisagreementError
        Independent methods gave different answers.
    """
    try:
        model = parse_model(file.read_text(encoding="utf-8-sig"))
        return margin_of_model(model)
    except OSError as error:
        raise ModelFileError(f"{file}: {error.strerror}; wanted a JSON model") from None
    except UnicodeDecodeError:
        raise ModelFileError(f"{file}: read bytes that are not UTF-8, wanted a JSON model") from None
    except BadModelError as error:
        raise ModelFileError(f"{file}: {error}") from None


def margin_of_scenario(file: Path) -> dict[str, Any]:
    """The margin of the loop that a scenario flies: of the continuous model, and as flown, sampled and held.

    Raises
    ------
    ModelFileError, scenarios.errors.ScenarioError, GainsError
        One line with what was read and what was wanted.
    """
    from gains.sampled.onboard import own_part
    from gcs.plan.planner import flight_plan
    from scenarios.files import load

    scenario = load(file)
    if scenario.dynamics == "autopilot":
        wanted = "double_integrator: gcs design and gcs fly tell the margin with an autopilot's response"
        raise ModelFileError(f"{file}: dynamics: read 'autopilot', wanted {wanted}")
    design, plan = flight_plan(scenario)
    model, onboard = plan.model, plan.scenario.control.loop == "onboard"
    at_once = own_part(model, plan.gain) if onboard else np.zeros_like(plan.gain)
    terms = Term(model.A + model.B @ at_once, 0.0, Fraction(0)), Term(model.B @ (plan.gain - at_once), 0.0, Fraction(1))
    result = margin_of_model(DelayModel(terms, "tau"))
    sampled_s = design.delay_margin_s
    what = "own errors at once, those of others late" if onboard else "all feedback late"
    flown = "no limit" if sampled_s is None else f"margin {sampled_s:.6g} s"
    note = f"as flown, sampled and held every {design.period_s * 1e3:g} ms: {flown}"
    notes = [f"loop {plan.scenario.control.loop}: {what}", note, *result["notes"]]
    return result | {"loop": plan.scenario.control.loop, "delay_margin_sampled_s": sampled_s, "notes": notes}


def margin_of_model(model: DelayModel | HeldModel) -> dict[str, Any]:
    """The margin of one model as plain types."""
    found = loop_margin(model)
    if isinstance(found, LoopAtGivenDelays):
        return _plain_at_given_delays(found)
    return _plain_margin(found)


def _plain_at_given_delays(found: LoopAtGivenDelays) -> dict[str, Any]:
    return {
        "unknown": None,
        "stable": found.is_stable,
        "rightmost_root": [found.rightmost_root.real, found.rightmost_root.imag],
        "unstable_roots_at_zero_delay": found.unstable_roots_at_zero_delay,
        "stable_intervals_s": None,
        "delay_margin_s": None,
        "delay_independent": None,
        "crossings": [],
    }


def _plain_margin(found: LoopMargin) -> dict[str, Any]:
    return {
        "unknown": found.unknown,
        "stable_intervals_s": [[_plain(end_s) for end_s in window] for window in found.stable_intervals_s],
        "delay_margin_s": _plain(found.delay_margin_s),
        "delay_margin_error_s": found.delay_margin_error_s,
        "delay_independent": not isfinite(found.delay_margin_s),
        "crossings": [_plain_crossing(crossing) for crossing in found.crossings],
        "unstable_roots_at_zero_delay": found.unstable_roots_at_zero_delay,
        "roots_fixed_at_zero": found.roots_fixed_at_zero,
        "complete_to_s": _plain(found.complete_to_s),
        "checked_by": list(found.checked_by),
        "notes": list(found.notes),
    }


def _plain_crossing(crossing: MarginCrossing) -> dict[str, Any]:
    fields = {"omega_rad_s": crossing.omega_rad_s, "delay_s": crossing.delay_s, "direction": crossing.direction}
    told = {"roots": crossing.roots, "repeats_every_s": crossing.repeats_every_s}
    error_s = {"delay_error_s": _plain(crossing.delay_error_s)}
    return fields | {name: value for name, value in told.items() if value is not None} | error_s


def print_margin(result: dict[str, Any]) -> None:
    """Print the verdict, the crossings and the notes."""
    from rich.table import Table

    from gcs.views.console import plain_console

    console = plain_console()
    for line in _verdict_lines(result):
        console.print(line)
    if result["crossings"]:
        unknown = "period s" if result["unknown"] == "period" else "delay s"
        table = Table(
            "omega rad/s", unknown, "roots go", title="crossings of the stability boundary", title_justify="left"
        )
        for crossing in result["crossings"][:_ROWS]:
            way = {1: "right: unstable", -1: "left: stable", 0: "touch"}[crossing["direction"]]
            delay_s = as_known(crossing["delay_s"], crossing["delay_error_s"] or 0.0)
            # both have about the same relative error
            share = (crossing["delay_error_s"] or 0.0) / max(crossing["delay_s"], 1e-300)
            omega = as_known(crossing["omega_rad_s"], share * crossing["omega_rad_s"])
            table.add_row(omega, delay_s, way)
        console.print(table)
        _print_more(console, result["crossings"], "crossings")
    for note in result.get("notes", []):
        console.print(note)


def _verdict_lines(result: dict[str, Any]) -> list[str]:
    name = result["unknown"]
    if name is None:
        real, imaginary = result["rightmost_root"]
        verdict = "stable" if result["stable"] else "not stable"
        return [f"{verdict}: rightmost root {real:.6g} +- {imaginary:.6g}j 1/s"]
    windows = result["stable_intervals_s"]
    lines = [f"{name}: stable from {_end(result, start)} to {_end(result, end)}" for start, end in windows[:_ROWS]]
    if len(windows) > _ROWS:
        lines.append(f"and {len(windows) - _ROWS} more windows")
    if not windows:
        lines.append(f"not stable at any {name}" if result["complete_to_s"] is None else f"not stable at {name} = 0")
    lines.append(_margin_line(result["delay_margin_s"], result["delay_margin_error_s"]))
    if result["unstable_roots_at_zero_delay"]:
        lines.append(f"unstable roots at {name} = 0: {result['unstable_roots_at_zero_delay']}")
    if result["checked_by"]:
        lines.append(f"confirmed by {' and '.join(result['checked_by'])}")
    return lines


def _margin_line(margin_s: float | None, error_s: float) -> str:
    if margin_s is None:
        return "no limit: stable at every delay"
    line = f"margin {as_known(margin_s, error_s)} s"
    if margin_s > 0.0 and error_s > 0.5e-6 * margin_s:
        line += f", known to {error_s:.0e} s: nearly equal roots cross together"
    return line


def _end(result: dict[str, Any], end_s: float | None) -> str:
    """One end of a window, with as many digits as are known of the crossing there."""
    if end_s is None:
        return "any delay"
    error_s = 0.0
    for crossing in result["crossings"]:
        turns = (end_s - crossing["delay_s"]) / crossing.get("repeats_every_s", inf)
        if abs(turns - round(turns)) * crossing.get("repeats_every_s", end_s) <= 1e-9 * end_s:
            # every further turn adds the error of the frequency once
            error_s = max(error_s, (crossing["delay_error_s"] or 0.0) * (1.0 + abs(turns)))
    return f"{as_known(end_s, error_s)} s"


def _print_more(console: Any, rows: list[Any], what: str) -> None:
    if len(rows) > _ROWS:
        console.print(f"and {len(rows) - _ROWS} more {what}")


def _plain(number: float) -> float | None:
    return number if isfinite(number) else None
