"""The delay margin of any linear loop that `gains.margin.model_file` reads, and the methods that confirm it.

The analysis depends on the model: `gains.delay._commensurate` for multiples of the unknown delay, `gains.delay._mixed`
if there are also known delays, `gains.sampled.constant` for a held loop with known period, and `gains.sampled._period`
if the period is the unknown. `gains.margin.opinions` gives second opinions on continuous loops.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, floor, gcd, inf, lcm, log10, nan, pi

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError, DisagreementError
from gains.core.structure import (
    Block,
    balanced,
    block_diagonal,
    distinct_blocks,
    is_singular_for_any_delay,
    of_type,
    without_fixed_roots,
)
from gains.delay._crossings import DelayedTerm, by_multiple, crossing_errors
from gains.delay._loci import factor_rank
from gains.delay._windows import DelayAnalysis, combined_analysis
from gains.delay.constant import Crossing
from gains.margin.model_file import DelayModel, HeldModel
from gains.margin.opinions import second_opinions
from gains.sampled._loop import HeldPlant, held_blocks, lifted_map, radius_of, sensitivity

# largest multiple of the unknown, in units of the common divisor of all multiples
_MOST_STEPS = 200
# most digits printed
_DIGITS = 6
# errors are estimated only for the first crossings: there may be thousands
_ERRORS_OF = 100
# the spectral radius is checked at this relative distance on each side of the margin of a held loop
_BESIDE = 1e-4
# largest one-period map that is checked; it takes 0.2 s
_LARGEST_MAP = 300
# error of an eigenvalue of such a map
_ROUNDING = 1e-11
# backward error of such a map, in units of n eps and its norm
_BACKWARD = 10.0
# the rounding of the matrices and of a delay alone moves a root this far, relative to its size
_ON_AXIS = 8.0 * float(np.finfo(np.float64).eps)
# relative distance of neighbouring delays or periods, and the noise of a radius in units of the spread at three of them
_NEIGHBOUR, _NOISE = 1e-15, 4.0


@dataclass(frozen=True)
class MarginCrossing:
    """Roots on the imaginary axis, or on the unit circle for a sampled loop, at one value of the unknown.

    `delay_s` is that value and `delay_error_s` its error (nan if not estimated); `direction` is as in
    `gains.delay.constant.Crossing`. `roots` and `repeats_every_s` are None for sampled loops. `repeats_every_s` is also
    None for a real root, which passes zero once.
    """

    omega_rad_s: float
    delay_s: float
    direction: int
    roots: int | None
    repeats_every_s: float | None
    delay_error_s: float


@dataclass(frozen=True, kw_only=True)
class LoopMargin:
    """The verdict on a loop for all values of its `unknown`: a delay, or the sampling period."""

    unknown: str
    """Name of the unknown; "period" for the sampling period."""
    stable_intervals_s: tuple[tuple[float, float], ...]
    """The stability windows, complete up to `complete_to_s`; the last may end at inf."""
    delay_margin_s: float
    delay_margin_error_s: float
    """The end of the window that begins at 0, or 0 if none does, and its estimated error; nan if that is unknown."""
    crossings: tuple[MarginCrossing, ...]
    unstable_roots_at_zero_delay: int
    """The number of unstable roots when the unknown is zero."""
    roots_fixed_at_zero: int = 0
    """The number of roots that stay at 0 (at z = 1 for a held loop); they are left out of everything else."""
    complete_to_s: float
    checked_by: tuple[str, ...] = ()
    """The methods that confirmed the windows."""
    notes: tuple[str, ...]


@dataclass(frozen=True)
class LoopAtGivenDelays:
    """A loop whose delays are all known: its rightmost root (1/s), and its number of unstable roots without delay."""

    rightmost_root: complex
    unstable_roots_at_zero_delay: int
    roots_fixed_at_zero: int = 0
    """The number of roots that stay at 0 whatever the delays; they are left out of everything else."""

    @property
    def is_stable(self) -> bool:
        """Whether all other roots are left of the imaginary axis by more than their rounding."""
        return self.rightmost_root.real < -_ON_AXIS * abs(self.rightmost_root)


def loop_margin(model: DelayModel | HeldModel) -> LoopMargin | LoopAtGivenDelays:
    """The delays, or the sampling periods, at which the loop of a model is stable.

    Raises BadModelError if the model cannot be analysed, saying what was read and what was wanted, and
    DisagreementError if independent methods give different answers.

    >>> from gains import loop_margin, parse_model
    >>> found = loop_margin(parse_model('{"A0": [[0]], "A1": [[-1]]}'))
    >>> round(found.delay_margin_s, 6), found.checked_by
    (1.570796, ('sweep', 'rightmost root'))
    """
    of_type("model", model, DelayModel, HeldModel)
    if isinstance(model, HeldModel):
        return _with_unknown_period(model) if model.period_s is None else _with_known_period(model, model.period_s)
    return _with_unknown_delay(model) if model.unknown else _at_given_delays(model)


def as_known(value: float, error: float) -> str:
    """A number printed with the digits that its error permits, at most six; the last is off by at most one.

    >>> as_known(0.8152534, 1e-12), as_known(0.8152534, 8e-5), as_known(0.8152534, 0.4)
    ('0.815253', '0.815', '0.8')
    """
    if not error > 0.0 or value == 0.0:
        return f"{value:.{_DIGITS}g}"
    # a unit of the last digit is at least twice the error: the error takes one half of it, rounding the other
    digits = floor(log10(abs(value))) + 1 - ceil(log10(2.0 * error))
    return f"{value:.{min(max(digits, 1), _DIGITS)}g}"


def _at_given_delays(model: DelayModel) -> LoopAtGivenDelays:
    from gains.delay.rightmost import rightmost_roots

    # rounding would move a root at 0 to either side
    moving, fixed = without_fixed_roots(*(term.matrix for term in model.terms))
    late: list[complex] = []
    unstable = 0
    for block in distinct_blocks(*moving):
        terms = [(A, term.fixed_s) for A, term in zip(block.matrices, model.terms, strict=True)]
        roots, at_once = rightmost_roots(terms, 2), np.linalg.eigvals(np.sum(block.matrices, axis=0))
        # a root at 0 where feedback cancels, as with an unknown delay, unless the block has no other root
        if len(roots) > 1 and np.any(block.matrices) and is_singular_for_any_delay(balanced(*block.matrices)):
            if roots[1].real <= 0.0:  # else both may be right of it
                roots = np.delete(roots, np.argmin(np.abs(roots)))
            at_once = np.delete(at_once, np.argmin(np.abs(at_once)))
            fixed += block.copies
        late.append(complex(roots[0]))
        unstable += block.copies * int(np.count_nonzero(at_once.real > 0.0))
    return LoopAtGivenDelays(max(late, key=lambda root: root.real), unstable, fixed)


def _with_unknown_delay(model: DelayModel) -> LoopMargin:
    unit = _common_divisor([term.multiple for term in model.terms])
    # analysed in units of the common divisor of the delays, `unit` times the unknown; results are scaled back
    read = [
        DelayedTerm(term.matrix, term.fixed_s if term.matrix.any() else 0.0, int(term.multiple / unit))
        for term in model.terms
    ]
    most = max(term.multiple for term in read)
    if most > _MOST_STEPS:
        raise BadModelError(
            f"terms: read delays up to {most} times their common divisor {unit}*{model.unknown}, "
            f"wanted at most {_MOST_STEPS} times"
        )
    terms, analysis, taken_out = _analysed(read)
    checked_by, margin_error_s = second_opinions(analysis, terms)
    scale = 1.0 / float(unit)
    fixed = taken_out + analysis.roots_fixed_at_zero
    notes = fixed_note(fixed, "0 at every delay")
    if not fixed and not analysis.stable_intervals_s:
        blocks = distinct_blocks(*(term.matrix for term in terms))
        if any(is_singular_for_any_delay(balanced(*block.matrices)) for block in blocks):
            notes = ("a root stays at 0 at every delay, so the loop is asymptotically stable at none",)
    starts_s = [start_s for start_s, _ in analysis.stable_intervals_s]
    if 0.0 in starts_s and any(crossing.delay_s == 0.0 for crossing in analysis.crossings):
        notes += (f"at {model.unknown} = 0 itself roots are on the imaginary axis: stable only beyond it",)
    places = [(crossing.omega_rad_s, crossing.delay_s) for crossing in analysis.crossings[:_ERRORS_OF]]
    errors_s = [by_delay_s * scale for _, by_delay_s in crossing_errors(terms, places)]
    errors_s += [np.nan] * (len(analysis.crossings) - len(errors_s))
    return LoopMargin(
        unknown=model.unknown,
        stable_intervals_s=tuple((start_s * scale, end_s * scale) for start_s, end_s in analysis.stable_intervals_s),
        delay_margin_s=analysis.delay_margin_s * scale,
        delay_margin_error_s=margin_error_s * scale,
        crossings=tuple(
            _scaled(crossing, error_s, scale) for crossing, error_s in zip(analysis.crossings, errors_s, strict=True)
        ),
        unstable_roots_at_zero_delay=analysis.unstable_roots_at_zero_delay,
        roots_fixed_at_zero=fixed,
        complete_to_s=analysis.complete_to_s * scale,
        checked_by=checked_by,
        notes=notes,
    )


def _analysed(terms: list[DelayedTerm]) -> tuple[list[DelayedTerm], DelayAnalysis, int]:
    """The terms with each distinct block once, the analysis of the loop, and the number of fixed roots left out."""
    from gains.delay._commensurate import analyse_block
    from gains.delay._mixed import analyse_mixed_block

    mixed = any(term.known_s for term in terms)
    if not mixed:
        terms = [DelayedTerm(matrix, 0.0, k) for k, matrix in enumerate(by_multiple(terms))]
    blocks: list[Block] = []
    taken_out = 0
    for block in distinct_blocks(*(term.matrix for term in terms)):
        moving, fixed = without_fixed_roots(*block.matrices)
        taken_out += block.copies * fixed
        blocks += [replace(part, copies=part.copies * block.copies) for part in distinct_blocks(*moving)]
    once = block_diagonal([block.matrices for block in blocks])
    found = [analyse_mixed_block(block, terms, True) if mixed else analyse_block(block, True) for block in blocks]
    terms = [replace(term, matrix=matrix) for term, matrix in zip(terms, once, strict=True)]
    return terms, combined_analysis(found, None), taken_out


def fixed_note(fixed: int, where: str) -> tuple[str, ...]:
    """Note on the roots that are left out; empty if there are none."""
    stay = "1 root stays" if fixed == 1 else f"{fixed} roots stay"
    why = "a motion that the loop does not bring back, such as the common value of a consensus"
    if fixed > 1:
        why = f"{why}; if one of them drives another, it lets the other grow with time"
    return (f"{stay} at {where} ({why}); everything else is about the other roots",) if fixed else ()


def _held_moving(model: HeldModel) -> tuple[tuple[FloatArray, FloatArray, FloatArray], int]:
    """A, B and K of a held loop without its fixed roots, and the number of states removed.

    A direction along which neither A nor B K acts keeps an eigenvalue of the one-period map at one, at every delay and
    period; rounding would move it to either side of the unit circle.
    """
    (plant, feedback), fixed = without_fixed_roots(model.A, model.B @ model.K)
    return ((plant, *factor_rank(feedback)), fixed) if fixed else ((model.A, model.B, model.K), 0)


def _held_parts(loop: tuple[FloatArray, FloatArray, FloatArray], period_s: float) -> list[tuple[HeldPlant, int]]:
    """The blocks of a held loop with their numbers of copies; the whole loop, once, if no two blocks are equal."""
    A, B, K = loop
    plants, copies = held_blocks(A, B, K, period_s=period_s), [block.copies for block in distinct_blocks(A, B @ K)]
    return list(zip(plants, copies, strict=True)) if max(copies) > 1 else [(HeldPlant(A, B, K, period_s), 1)]


def _scaled(crossing: Crossing, error_s: float, scale: float) -> MarginCrossing:
    omega = crossing.omega_rad_s
    repeats_every_s = 2.0 * pi / omega * scale if omega > 0.0 else None
    delay_s = crossing.delay_s * scale
    return MarginCrossing(omega, delay_s, crossing.direction, crossing.roots, repeats_every_s, error_s)


def _with_unknown_period(model: HeldModel) -> LoopMargin:
    from gains.sampled._period import analyse_period

    loop, fixed = _held_moving(model)
    # block by block: equal followers in one map would spoil each other's eigenvalues
    parts = [part for part, _ in _held_parts(loop, 1.0)]

    def map_at(part: HeldPlant, period_s: float) -> FloatArray:
        return lifted_map(replace(part, period_s=period_s), 0.0)

    def error_s(period_s: float) -> float:
        crossing = min(parts, key=lambda part: abs(radius_of(map_at(part, period_s)) - 1.0))
        return _map_error(lambda at_s: map_at(crossing, at_s), period_s)

    analysis = analyse_period(*loop)
    crossings = tuple(
        MarginCrossing(
            c.omega_rad_s, c.period_s, c.direction, None, None, error_s(c.period_s) if i < _ERRORS_OF else nan
        )
        for i, c in enumerate(analysis.crossings)
    )
    return LoopMargin(
        unknown="period",
        stable_intervals_s=analysis.stable_intervals_s,
        delay_margin_s=analysis.limit_s,
        delay_margin_error_s=max((c.delay_error_s for c in crossings if c.delay_s == analysis.limit_s), default=0.0),
        crossings=crossings,
        unstable_roots_at_zero_delay=analysis.unstable_roots_at_zero_period,
        roots_fixed_at_zero=fixed,
        complete_to_s=analysis.complete_to_s,
        notes=("the unknown is the sampling period: u = K x, sampled and held", *fixed_note(fixed, "z = 1")),
    )


def _with_known_period(model: HeldModel, period_s: float) -> LoopMargin:
    """The first stability window of the held loop as flown."""
    from gains.sampled._crossings import block_delay_margin
    from gains.sampled.constant import sampled_delay_margin, spectral_radius

    loop, fixed = _held_moving(model)
    parts = _held_parts(loop, period_s)
    # block by block: equal followers in one map would spoil each other's eigenvalues
    first = parts[0][0] if len(parts) == 1 else min((part for part, _ in parts), key=block_delay_margin)

    def map_at(delay_s: float) -> FloatArray:
        return lifted_map(first, delay_s)

    margin_s = sampled_delay_margin(*loop, period_s=period_s)
    crossings: tuple[MarginCrossing, ...] = ()
    checks: tuple[str, ...] = ()
    if 0.0 < margin_s < inf and len(first.A) + first.B.shape[1] * (margin_s / period_s + 2.0) <= _LARGEST_MAP:
        delays_s = [(1.0 - _BESIDE) * margin_s, margin_s, (1.0 + _BESIDE) * margin_s]
        before, at, after = (spectral_radius(*loop, period_s=period_s, delay_s=delay_s) for delay_s in delays_s)
        # the radius may touch one at a whole period and be smaller on both sides
        if before >= 1.0 or max(at, after) < 1.0 - _ROUNDING:
            raise DisagreementError(
                f"the sampled delay margin is {margin_s} s at a period of {period_s} s, but the spectral radius of the "
                f"one-period map is {before} before it, {at} at it and {after} after it"
            )
        checks = ("spectral radius",)
        eigenvalues = np.linalg.eigvals(map_at(margin_s))
        omega = abs(float(np.angle(eigenvalues[np.argmax(np.abs(eigenvalues))]))) / period_s
        crossings = (MarginCrossing(omega, margin_s, 1, None, None, _map_error(map_at, margin_s)),)
    at_once = [(np.linalg.eigvals(lifted_map(part, 0.0)), copies) for part, copies in parts]
    beyond = "" if margin_s == inf else "; delays beyond the margin were not examined"
    return LoopMargin(
        unknown="tau",
        stable_intervals_s=((0.0, margin_s),) if margin_s > 0.0 else (),
        delay_margin_s=margin_s,
        delay_margin_error_s=crossings[0].delay_error_s if crossings else nan if 0.0 < margin_s < inf else 0.0,
        crossings=crossings,
        unstable_roots_at_zero_delay=sum(
            copies * int(np.count_nonzero(np.abs(z) > 1.0 + _ROUNDING)) for z, copies in at_once
        ),
        roots_fixed_at_zero=fixed,
        complete_to_s=margin_s,
        checked_by=checks,
        notes=(f"u = K x, sampled and held every {period_s:g} s, acts tau late{beyond}", *fixed_note(fixed, "z = 1")),
    )


def _map_error(map_at: Callable[[float], FloatArray], at_s: float) -> float:
    """Rounding error (s) of the delay or period at which the spectral radius of a one-period map passes one.

    At this distance, on both sides, the radius differs from one by more than rounding. The distance is doubled until it
    does. The first one tried comes from the slope over a wider interval, which misleads near a double eigenvalue.
    """
    if len(map_at(at_s)) > _LARGEST_MAP:
        return np.nan
    step_s = _BESIDE * at_s
    before, after = (radius_of(map_at(at_s + way * step_s)) for way in (-1.0, 1.0))
    slope = abs(after - before) / (2.0 * step_s)
    # maps of neighbouring numbers differ by the rounding of a matrix exponential. If the states have very different
    # units, it far exceeds the rounding of an eigenvalue
    radii = [radius_of(map_at(at_s * (1.0 + k * _NEIGHBOUR))) for k in (-1, 0, 1)]
    noise = _NOISE * (max(radii) - min(radii))
    error_s = max(_radius_error(map_at(at_s)), noise) / slope if slope > 0.0 else at_s
    while error_s < at_s:
        beside = [map_at(at_s + way * error_s) for way in (-1.0, 1.0)]
        if all(abs(radius_of(step) - 1.0) > max(_radius_error(step), noise) for step in beside):
            break
        error_s *= 2.0
    return min(error_s, at_s)


def _radius_error(matrix: FloatArray) -> float:
    """Rounding error of the spectral radius of a one-period map."""
    size = len(matrix)
    epsilon = _BACKWARD * size * float(np.finfo(np.float64).eps) * float(np.linalg.norm(matrix))
    return min(epsilon * sensitivity(matrix), epsilon ** (1.0 / max(size, 2)))


def _common_divisor(multiples: list[Fraction]) -> Fraction:
    """The largest fraction that divides all multiples; 1 if all are zero."""
    denominator = lcm(*(multiple.denominator for multiple in multiples))
    return Fraction(gcd(*(int(multiple * denominator) for multiple in multiples)), denominator) or Fraction(1)
