"""`gcs margin`: how much delay any linear loop takes, from a JSON model or a scenario to a verdict checked twice.

The exact analysis is confirmed by two others that share no algebra with it, a sweep along the unit circle and the
rightmost root beside the ends of the windows, as far as they take a fraction of a second; `checked_by` in the result
says which. A contradiction is an error.
"""

from fractions import Fraction
from math import gcd, inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from gains.delay import Crossing, DelayAnalysis, analyse_delay
from gains.errors import BadModelError, DisagreementError
from gains.model_file import DelayModel, HeldModel, Term, parse_model
from gains.structure import FloatArray, balanced, distinct_blocks, is_singular_for_any_delay, without_equilibria

# multiples of the unknown up to this many times their common divisor
_MOST_STEPS = 200
# a sweep of blocks of n states costs some n^3: these are 0.2 s, and 0.08 s one of 12 states
_SWEEP_BUDGET = 14_000
# states times points of a discretised spectrum: 30 ms
_SPECTRUM_BUDGET = 200
# the rightmost root is looked at this far inside and outside a window, relative to its end
_BESIDE = 1e-4
# a near-tangent pair of crossings is known to sqrt(eps) only; a missed crossing is off by far more
_AGREEMENT = 1e-6
# a rightmost root this close to the axis, relative to the norm, is not evidence for either side
_UNDECIDED = 1e-9
# least singular value of a characteristic matrix with rows of unit length, at a root
_TOUCH = 1e-7
# rows of a table on the terminal
_ROWS = 20


class ModelFileError(BadModelError):
    """The model file cannot be used: one line with file, key, what was read and what was wanted."""


def margin_of_file(file: Path) -> dict[str, Any]:
    """What `gcs margin` prints, as plain types; an unbounded number is None.

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
    """The same for the loop that a scenario flies: the continuous model in full, and the margin as flown.

    Raises
    ------
    ModelFileError, scenarios.errors.ScenarioError, GainsError
        One line with what was read and what was wanted.
    """
    from gains.onboard import own_part
    from gcs.plan import flight_plan
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
    sampled_s = design["delay_margin_s"]
    what = "own errors at once, those of others late" if onboard else "all feedback late"
    flown = "no limit" if sampled_s is None else f"margin {sampled_s:.6g} s"
    note = f"as flown, sampled and held every {design['period_s'] * 1e3:g} ms: {flown}"
    notes = [f"loop {plan.scenario.control.loop}: {what}", note, *result["notes"]]
    return result | {"loop": plan.scenario.control.loop, "delay_margin_sampled_s": sampled_s, "notes": notes}


def margin_of_model(model: DelayModel | HeldModel) -> dict[str, Any]:
    """The result for one model; exceptions of the analyses as they are."""
    if isinstance(model, HeldModel):
        return _of_held_loop(model)
    if not model.unknown:
        return _of_numbers(model)
    return _of_unknown_delay(model)


def _of_numbers(model: DelayModel) -> dict[str, Any]:
    from gains.rightmost import rightmost_root

    root = rightmost_root([(term.matrix, term.fixed_s) for term in model.terms])
    unstable = _unstable_eigenvalues(sum((term.matrix for term in model.terms), np.zeros_like(model.terms[0].matrix)))
    return {
        "unknown": None,
        "stable": root.real < 0.0,
        "rightmost_root": [root.real, root.imag],
        "unstable_roots_at_zero_delay": unstable,
        "stable_intervals_s": None,
        "delay_margin_s": None,
        "delay_independent": None,
        "crossings": [],
    }


def _of_unknown_delay(model: DelayModel) -> dict[str, Any]:
    matrices, fixed = without_equilibria(*(term.matrix for term in model.terms))
    known_s = [term.fixed_s for term in model.terms]
    unit = _common_divisor([term.multiple for term in model.terms])
    steps = [int(term.multiple / unit) for term in model.terms]
    if max(steps) > _MOST_STEPS:
        raise BadModelError(
            f"terms: read delays up to {max(steps)} times their common divisor {unit}*{model.unknown}, "
            f"wanted at most {_MOST_STEPS} times"
        )
    if any(known_s):
        analysis, checks = _with_known_delays(matrices, known_s, steps)
    else:
        analysis, checks = _commensurate(matrices, steps)
    # the analysis is in the common divisor of the delays; the unknown is that divided by `unit`
    scale = 1.0 / float(unit)
    at_zero = [] if analysis.stable_intervals_s or fixed else _singular_note(matrices)
    notes = [_fixed_note(fixed)] if fixed else at_zero
    return {
        "unknown": model.unknown,
        "stable_intervals_s": [[_plain(end_s * scale) for end_s in window] for window in analysis.stable_intervals_s],
        "delay_margin_s": _plain(analysis.delay_margin_s * scale),
        "delay_independent": analysis.delay_independent,
        "crossings": [
            {
                "omega_rad_s": crossing.omega_rad_s,
                "delay_s": crossing.delay_s * scale,
                "direction": crossing.direction,
                "roots": crossing.roots,
                "repeats_every_s": 2.0 * np.pi / crossing.omega_rad_s * scale,
            }
            for crossing in analysis.crossings
        ],
        "unstable_roots_at_zero_delay": analysis.unstable_roots_at_zero_delay,
        "roots_fixed_at_zero": fixed,
        "complete_to_s": _plain(analysis.complete_to_s * scale),
        "checked_by": checks,
        "notes": notes,
    }


def _of_held_loop(model: HeldModel) -> dict[str, Any]:
    from gains.period_windows import analyse_period

    analysis = analyse_period(model.A, model.B, model.K)
    return {
        "unknown": "period",
        "stable_intervals_s": [[_plain(end_s) for end_s in window] for window in analysis.stable_intervals_s],
        "delay_margin_s": _plain(analysis.limit_s),
        "delay_independent": analysis.limit_s == inf,
        "crossings": [
            {"omega_rad_s": crossing.omega_rad_s, "delay_s": crossing.period_s, "direction": crossing.direction}
            for crossing in analysis.crossings
        ],
        "unstable_roots_at_zero_delay": analysis.unstable_roots_at_zero_period,
        "complete_to_s": _plain(analysis.complete_to_s),
        "checked_by": [],
        "notes": ["the unknown is the sampling period: u = K x, sampled and held"],
    }


def _commensurate(matrices: tuple[FloatArray, ...], steps: list[int]) -> tuple[DelayAnalysis, list[str]]:
    """The analysis in the common divisor, and the names of the methods that confirmed it."""
    from gains.commensurate import analyse_commensurate, circle_sweep_margin

    terms = [np.zeros_like(matrices[0]) for _ in range(max(steps) + 1)]
    for matrix, step in zip(matrices, steps, strict=True):
        terms[step] = terms[step] + matrix
    analysis = analyse_delay(*terms) if len(terms) == 2 else analyse_commensurate(terms)
    checks: list[str] = []
    sizes = [len(block.indices) for block in distinct_blocks(*terms)]
    # a loop with roots on the axis at zero delay has no margin to a sweep, which judges zero delay by itself
    begins_on_axis = any(crossing.delay_s == 0.0 for crossing in analysis.crossings)
    if sum(size**3 for size in sizes) <= _SWEEP_BUDGET and not begins_on_axis:
        swept_s = circle_sweep_margin(terms)
        if _agree(analysis, swept_s, terms):
            checks.append("sweep")
    delayed = [(matrix, 0.0, step) for step, matrix in enumerate(terms)]
    return analysis, checks + _confirmed_by_spectrum(analysis, delayed, max(sizes))


def _agree(analysis: DelayAnalysis, swept_s: float, terms: list[FloatArray]) -> bool:
    """True if the sweep found the same margin, False if it missed a root that is on the axis there; else an error."""
    margin_s = analysis.delay_margin_s
    if margin_s == swept_s or abs(margin_s - swept_s) <= _AGREEMENT * margin_s:
        return True
    # a mere touch, or a motion that is slow beside others, is easily missed by a search
    if margin_s < swept_s and any(
        _is_root(terms, crossing) for crossing in analysis.crossings if crossing.delay_s == margin_s
    ):
        return False
    raise DisagreementError(f"the exact delay margin is {margin_s} s, the sweep says {swept_s} s")


def _is_root(terms: list[FloatArray], crossing: Crossing) -> bool:
    """Whether the characteristic matrix is singular at the crossing, to rounding."""
    parts = balanced(*terms)
    turns = np.exp(-1j * crossing.omega_rad_s * crossing.delay_s * np.arange(len(parts)))
    matrix = 1j * crossing.omega_rad_s * np.eye(len(parts[0])) - np.tensordot(turns, np.array(parts), axes=1)
    rows = np.maximum(np.linalg.norm(matrix, axis=1), 1e-300)
    return bool(np.linalg.svd(matrix / rows[:, np.newaxis], compute_uv=False)[-1] < _TOUCH)


def _with_known_delays(
    matrices: tuple[FloatArray, ...], known_s: list[float], steps: list[int]
) -> tuple[DelayAnalysis, list[str]]:
    from gains.mixed_delays import MixedTerm, analyse_mixed

    terms = [MixedTerm(*term) for term in zip(matrices, known_s, steps, strict=True)]
    analysis = analyse_mixed(terms)
    delayed = list(zip(matrices, known_s, steps, strict=True))
    return analysis, _confirmed_by_spectrum(analysis, delayed, len(matrices[0]))


def _confirmed_by_spectrum(analysis: DelayAnalysis, terms: list[tuple[FloatArray, float, int]], size: int) -> list[str]:
    """Compare the windows with the rightmost root inside and beside them, where that is quick."""
    from gains.rightmost import rightmost_root

    rate = sum(float(np.linalg.norm(matrix)) for matrix, _, _ in terms)
    looked_at = 0
    for delay_s, stable in _delays_to_look_at(analysis, rate):
        delays = [known_s + step * delay_s for _, known_s, step in terms]
        if size * (12.0 + rate * max(delays) / 2.0) > _SPECTRUM_BUDGET:
            continue
        root = rightmost_root([(matrix, delay) for (matrix, _, _), delay in zip(terms, delays, strict=True)])
        looked_at += 1
        if (root.real < 0.0) != stable and abs(root.real) > _UNDECIDED * rate:
            raise DisagreementError(
                f"the loop should be {'stable' if stable else 'unstable'} at {delay_s} s, but its rightmost root there "
                f"is {root}; windows {analysis.stable_intervals_s}"
            )
    return ["rightmost root"] if looked_at > 0 else []


def _delays_to_look_at(analysis: DelayAnalysis, rate: float) -> list[tuple[float, bool]]:
    """A few delays with the verdict that the windows imply: beside the ends of the first windows, and inside."""
    if not analysis.stable_intervals_s:
        # a root on the axis may be taken for one on either side of it: the count must be of roots off the axis
        return [(0.0, False)] if analysis.unstable_roots_at_zero_delay > 0 and rate > 0.0 else []
    looks: list[tuple[float, bool]] = []
    for start_s, end_s in analysis.stable_intervals_s[:2]:
        if not isfinite(end_s):
            looks.append((start_s * (1.0 + _BESIDE) if start_s > 0.0 else 1.0 / rate, True))
            continue
        inside_s = min(_BESIDE * end_s, 0.1 * (end_s - start_s))
        looks.append((end_s - inside_s, True))
        following = [start for start, _ in analysis.stable_intervals_s if start > start_s]
        # windows may touch: at a double root that only touches the axis
        if not following or following[0] > end_s * (1.0 + 2.0 * _BESIDE):
            looks.append((end_s * (1.0 + _BESIDE), False))
        if start_s > 0.0:
            looks.append((start_s + inside_s, True))
    return looks


def _common_divisor(multiples: list[Fraction]) -> Fraction:
    """The largest fraction of which all multiples are whole multiples; 1 if all are zero."""
    present = [multiple for multiple in multiples if multiple != 0]
    if not present:
        return Fraction(1)
    denominator = np.lcm.reduce([multiple.denominator for multiple in present], dtype=object)
    return Fraction(gcd(*(int(multiple * denominator) for multiple in present)), int(denominator))


def _unstable_eigenvalues(matrix: FloatArray) -> int:
    return int(np.count_nonzero(np.linalg.eigvals(matrix).real > 0.0))


def _fixed_note(count: int) -> str:
    what = "1 root stays" if count == 1 else f"{count} roots stay"
    why = "an equilibrium, as the common value of a consensus"
    return f"{what} at 0 at every delay ({why}); all else is said of the others"


def _singular_note(matrices: tuple[FloatArray, ...]) -> list[str]:
    if not is_singular_for_any_delay(balanced(*matrices)):
        return []
    return ["a root stays at 0 at every delay, so the loop is asymptotically stable at none"]


def print_margin(result: dict[str, Any]) -> None:
    """The result as a short table on the terminal."""
    from rich.table import Table

    from gcs.console import plain_console

    console = plain_console()
    for line in _verdict_lines(result):
        console.print(line)
    if result["crossings"]:
        table = Table(
            "omega rad/s", "delay s", "roots go", title="crossings of the imaginary axis", title_justify="left"
        )
        for crossing in result["crossings"][:_ROWS]:
            way = {1: "right: unstable", -1: "left: stable", 0: "touch"}[crossing["direction"]]
            table.add_row(f"{crossing['omega_rad_s']:.6g}", f"{crossing['delay_s']:.6g}", way)
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
    lines = [f"{name}: stable from {start:.6g} s to {_until(end)}" for start, end in windows[:_ROWS]]
    if len(windows) > _ROWS:
        lines.append(f"and {len(windows) - _ROWS} more windows")
    if not windows:
        lines.append(f"not stable at any {name}")
    margin_s = result["delay_margin_s"]
    lines.append("no limit: stable at every delay" if margin_s is None else f"margin {margin_s:.6g} s")
    if result["unstable_roots_at_zero_delay"]:
        lines.append(f"unstable roots at {name} = 0: {result['unstable_roots_at_zero_delay']}")
    if result["checked_by"]:
        lines.append(f"confirmed by {' and '.join(result['checked_by'])}")
    return lines


def _until(end_s: float | None) -> str:
    return "any delay" if end_s is None else f"{end_s:.6g} s"


def _print_more(console: Any, rows: list[Any], what: str) -> None:
    if len(rows) > _ROWS:
        console.print(f"and {len(rows) - _ROWS} more {what}")


def _plain(number: float) -> float | None:
    return number if isfinite(number) else None
