"""Input and output of `gcs margin`: the delay margin of a JSON model or of a scenario's loop.

The mathematics is in `gains.margin.loop_margin`.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from math import inf, isfinite, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic_core import to_jsonable_python

from gains.core.errors import BadModelError
from gains.margin.loop_margin import LoopAtGivenDelays, LoopMargin, MarginCrossing, as_known, fixed_note, loop_margin
from gains.margin.model_file import DelayModel, Term, parse_model, with_short_zeros
from scenarios.errors import did_you_mean
from scenarios.shipped import names

if TYPE_CHECKING:  # it imports the schema of scenarios, which a JSON model does not need
    from gcs.plan.design import PredictionPart

_ROWS = 20
"""Maximum number of rows in a table."""
_CHUNK = 1 << 18
"""Number of characters read from a file at once."""


class ModelFileError(BadModelError):
    """The model file cannot be used: one line with file, key, what was read and what was wanted."""


@dataclass(frozen=True)
class ScenarioMargin:
    """The margin of the loop that a scenario flies: by the continuous model, and as flown (sampled and held)."""

    margin: LoopMargin
    loop: str
    delay_margin_sampled_s: float | None
    prediction: "PredictionPart | None"
    """The mismatch windows of a station that predicts; the margins above are those without prediction."""


def margin_of_file(file: Path) -> LoopMargin | LoopAtGivenDelays:
    """The margin of a JSON model, or of a MATLAB file whose variables have the names of its keys.

    Raises ModelFileError, whose one line names file, key, what was read and what was wanted, or DisagreementError if
    independent methods give different answers.
    """
    try:
        text = _mat_as_json(file) if file.suffix == ".mat" else _json_of(file)
        return loop_margin(parse_model(text))
    except FileNotFoundError:
        wanted = "a model or a scenario (see gcs scenarios)"
        raise ModelFileError(f"{file}: read no such file, wanted {wanted}{did_you_mean(file.stem, names())}") from None
    except OSError as error:
        raise ModelFileError(f"{file}: {error.strerror}, wanted a JSON model") from None
    except UnicodeDecodeError:
        raise ModelFileError(f"{file}: read bytes that are not UTF-8, wanted a JSON model") from None
    except BadModelError as error:
        raise ModelFileError(f"{file}: {error}") from None


def _json_of(file: Path) -> str:
    """The text with its many zeros shortened: the model of 1,000 vehicles takes 40 MB."""
    with file.open(encoding="utf-8-sig") as text:
        return "".join(with_short_zeros(part) for part in iter(partial(text.read, _CHUNK), ""))


def _mat_as_json(file: Path) -> str:
    """The variables of a MATLAB file (up to version 7.2) as the JSON that `parse_model` reads."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        variables = loadmat(file)
    except (MatReadError, NotImplementedError, ValueError, TypeError) as error:
        raise BadModelError(f"read {' '.join(str(error).split())}; wanted a MATLAB file, version 4 to 7.2") from None
    known = {name: value.tolist() for name, value in variables.items() if not name.startswith("__")}
    one = {"hold": bool, "period": float}
    for name in one.keys() & known.keys():
        if np.shape(known[name]) == (1, 1):
            known[name] = one[name](known[name][0][0])
    return json.dumps(known, default=str)


def margin_of_scenario(file: Path, *, allow_code: bool = False) -> ScenarioMargin:
    """The margin of the loop that a scenario flies.

    Raises ModelFileError, scenarios.errors.ScenarioError, GainsError: one line with what was read and what was wanted.
    """
    from gains.sampled.onboard import own_part
    from gcs.cli.options import load_scenario
    from gcs.plan.own_law import OWN_DYNAMICS
    from gcs.plan.planner import flight_plan

    scenario = load_scenario(file, allow_code=allow_code)
    if scenario.dynamics == "autopilot":
        wanted = "double_integrator: gcs design and gcs fly give the margin with an autopilot's response"
        raise ModelFileError(f"{file}: dynamics: read 'autopilot', wanted {wanted}")
    design, plan = flight_plan(scenario)
    if scenario.response is not None:
        raise ModelFileError(f"{file}: read a [response], wanted none: gcs design gives the margin with it")
    if design.margin_unknown:
        read = "code" if scenario.code else f"dynamics {scenario.dynamics!r}"
        way = "a [response], as gcs identify prints it, for gcs design; or gcs stress --onset"
        wanted = way if design.margin_unknown == OWN_DYNAMICS else design.margin_unknown
        raise ModelFileError(f"{file}: read {read} without a linear model of its loop, wanted {wanted}")
    model, loop = plan.model, plan.scenario.control.loop
    what, at_once = "all feedback late", np.zeros_like(plan.gain)
    if plan.onboard is not None:
        what, at_once = "own errors at once, those of others late", own_part(model, plan.gain)
    terms = Term(model.A + model.B @ at_once, 0.0, Fraction(0)), Term(model.B @ (plan.gain - at_once), 0.0, Fraction(1))
    found = loop_margin(DelayModel(terms, "tau"))
    assert isinstance(found, LoopMargin)
    sampled_s = design.delay_margin_s
    flown = "no limit" if sampled_s is None else f"margin {sampled_s:.6g} s"
    note = f"as flown, sampled and held every {design.period_s * 1e3:g} ms: {flown}"
    if design.prediction is not None:
        note = note.replace("as flown", "without prediction")
    margin = replace(found, notes=(f"loop {loop}: {what}", note, *found.notes))
    return ScenarioMargin(margin, loop, sampled_s, design.prediction)


def margin_fields(found: LoopMargin | LoopAtGivenDelays | ScenarioMargin) -> dict[str, Any]:
    """The JSON fields of a margin: null for an unbounded number; a crossing has only its known fields."""
    if isinstance(found, ScenarioMargin):
        flown = {"loop": found.loop, "delay_margin_sampled_s": found.delay_margin_sampled_s}
        predicted = {} if found.prediction is None else {"prediction": found.prediction.to_dict()}
        return margin_fields(found.margin) | flown | predicted
    if isinstance(found, LoopAtGivenDelays):
        unknown = dict.fromkeys(("unknown", "stable_intervals_s", "delay_margin_s", "delay_independent"))
        return unknown | {
            "stable": found.is_stable,
            "rightmost_root": [found.rightmost_root.real, found.rightmost_root.imag],
            "unstable_roots_at_zero_delay": found.unstable_roots_at_zero_delay,
            "roots_fixed_at_zero": found.roots_fixed_at_zero,
            "crossings": [],
            "notes": fixed_note(found.roots_fixed_at_zero, "0 at every delay"),
        }
    crossings = [{name: known for name, known in vars(c).items() if known is not None} for c in found.crossings]
    fields = vars(found) | {"crossings": crossings, "delay_independent": not isfinite(found.delay_margin_s)}
    return to_jsonable_python(fields, inf_nan_mode="null")


def print_margin(found: LoopMargin | LoopAtGivenDelays | ScenarioMargin) -> None:
    from gcs.views.console import plain_console, table_of

    console = plain_console()
    if isinstance(found, LoopAtGivenDelays):
        root, verdict = found.rightmost_root, "stable" if found.is_stable else "not stable"
        console.print(f"{verdict}: rightmost root {root.real:.6g} +- {root.imag:.6g}j 1/s")
        for note in fixed_note(found.roots_fixed_at_zero, "0 at every delay"):
            console.print(note)
        return
    by, margin = "", found.margin if isinstance(found, ScenarioMargin) else found
    if isinstance(found, ScenarioMargin):  # first the loop as flown, then its model
        loop, flown, *more = margin.notes
        console.print(f"{flown}\n{loop}")
        by, margin = "continuous model: ", replace(margin, notes=tuple(more))
    for line in _verdict_lines(margin):
        console.print(f"{by}{line}")
    if margin.crossings:
        columns: dict[str, Callable[[MarginCrossing], str]] = {
            # the relative error of the frequency is about the error of the phase
            "omega rad/s": lambda c: as_known(c.omega_rad_s, c.delay_error_s * c.omega_rad_s**2),
            "period s" if margin.unknown == "period" else "delay s": lambda c: as_known(c.delay_s, c.delay_error_s),
            "roots go": lambda c: {1: "right: unstable", -1: "left: stable", 0: "touch"}[c.direction],
        }
        console.print(table_of(margin.crossings[:_ROWS], columns, title=f"{by}crossings of the stability boundary"))
        if len(margin.crossings) > _ROWS:
            console.print(f"and {len(margin.crossings) - _ROWS} more crossings")
    for note in margin.notes:
        console.print(note)
    if isinstance(found, ScenarioMargin) and found.prediction is not None:
        from gcs.views.report import windows_table

        console.print(windows_table(found.prediction))


def _verdict_lines(margin: LoopMargin) -> list[str]:
    name, windows = margin.unknown, margin.stable_intervals_s
    margin_s, error_s = margin.delay_margin_s, margin.delay_margin_error_s
    lines = [f"{name}: stable from {_end(margin, start)} to {_end(margin, end)}" for start, end in windows[:_ROWS]]
    if len(windows) > _ROWS:
        lines.append(f"and {len(windows) - _ROWS} more windows")
    if not windows:
        lines.append(f"not stable at {name} = 0" if isfinite(margin.complete_to_s) else f"not stable at any {name}")
    if isfinite(margin_s):
        rough = margin_s > 0.0 and error_s > 0.5e-6 * margin_s
        why = f", known to {error_s:.0e} s: nearly equal roots cross together" if rough else ""
        why = ", its error is not known" if isnan(error_s) else why
        lines.append(f"margin {as_known(margin_s, error_s)} s{why}")
    else:
        lines.append("no limit: stable at every delay")
    if margin.unstable_roots_at_zero_delay:
        lines.append(f"unstable roots at {name} = 0: {margin.unstable_roots_at_zero_delay}")
    if margin.checked_by:
        lines.append(f"confirmed by {' and '.join(margin.checked_by)}")
    return lines


def _end(margin: LoopMargin, end_s: float) -> str:
    """One end of a window, with as many digits as the crossing there is known to."""
    if not isfinite(end_s):
        return "any delay"
    error_s = 0.0
    for crossing in margin.crossings:
        turns = (end_s - crossing.delay_s) / (crossing.repeats_every_s or inf)
        if abs(turns - round(turns)) * (crossing.repeats_every_s or end_s) <= 1e-9 * end_s:
            # every further turn adds the error of the frequency once; an error that was not estimated is nan
            error_s = max(error_s, crossing.delay_error_s * (1.0 + abs(turns)))
    return f"{as_known(end_s, error_s)} s"
