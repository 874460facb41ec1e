"""The delay margin of one block of the sampled and held loop of `gains.sampled.constant`.

With z = e^{j phi}, phi = omega T, an eigenvalue of the one-period map is on the unit circle at the delay
tau = (q + m) T, q whole and 0 <= m < 1, exactly when z^{q+1} is an eigenvalue of the r x r loop

    H_m(z) = K (z I - Phi)^{-1} (G0(m) z + G1(m)).

For each m there are finitely many angles phi, independent of q, at which an eigenvalue of H_m has modulus one. They
change little within a period, so those at a few m lead to every crossing without a march through the delays. For one
input they come from eigenvalues of a Hamiltonian matrix and none is missed; for several, from a refined sweep.
"""

from functools import lru_cache
from math import ceil, floor, inf, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.core._bracketing import bracketed_roots
from gains.core.arrays import FloatArray
from gains.core.errors import DisagreementError
from gains.delay._crossings import separating_points
from gains.delay._loci import delay_loci, sweep_frequencies, unit_crossings, unit_gain_roots, with_extrema
from gains.sampled._loop import SampledPlant, block_radius, lifted_map, sensitivity, split_delay

# least number of fractions m of a period at which the angles are computed; more if the loop is fast for its period
_FRACTIONS = 8
_REFINEMENTS = (1, 4, 16)
# turns of a locus tried at the finer fractions: an angle that exists for 1/20 of a period meets a whole q in about 20
_TURNS = 40
# loci below this at eight fractions do not reach one between them
_SMALL = 0.8
# one-period maps larger than this are not checked by eigenvalues: each takes 20 ms or more
_LARGEST_CHECK = 120
# fractions of the margin at which it is checked: the radius changes by about a part in 10^6, its error is 1e-12
_BELOW, _ABOVE = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 1.0 - 1e-6), 1.0 + 1e-6
# a radius within the first of one is no evidence: at a whole period it may pass one with no slope. Near a multiple
# eigenvalue one within its rounding error is none either, up to the second
_AT_ONE, _MOST_ERROR = 1e-11, 1e-3
# |H(-1)| below this at all fractions of a period cannot reach one in between
_FAR_FROM_ONE = 0.5
# a residual this small relative to its terms is rounding; delays this close together (in periods) are the same
_ROUNDING, _SAME_PLACE = 1e-11, 1e-6
# where Newton's method ends without settling, a residual this small beside its terms is that of a multiple root
_SOLVED = 1e-15


@lru_cache(maxsize=256)
def block_delay_margin(plant: SampledPlant) -> float:
    """The least delay tau (s) at which the block loses stability; 0 if unstable without delay, `inf` if never.

    `inf` means that no root crosses at the fractions m of a period that are looked at: either no locus of H_m has
    modulus one, so no delay is too long, or no crossing lies within 40 turns of a locus. Fractions in between are not
    looked at, and with several inputs the angles come from a sweep over frequencies.

    Cached for each plant: designs, margins over links and loops of single vehicles all need it.

    DisagreementError if the eigenvalues of the one-period map contradict the crossings found.
    """
    if block_radius(plant, 0.0) >= 1.0:
        return 0.0
    if plant.B.shape[1] == 0:
        return inf
    contradiction = ""
    # at periods near the loop's limit, angles may appear and vanish between two fractions, so refine
    for refinement in _REFINEMENTS:
        off_axis_s = _least_delay_off_the_real_axis(plant, refinement)
        margin_s = min(off_axis_s, _least_delay_at_minus_one(plant, refinement))
        contradiction = _contradiction(plant, margin_s)
        # angles may also exist between two fractions only, for a loop that is unstable at long delays alone
        if not contradiction and (margin_s < inf or refinement == _REFINEMENTS[-1] or _has_small_loci(plant)):
            return float(margin_s)
    raise DisagreementError(contradiction)


def _has_small_loci(plant: SampledPlant) -> bool:
    """Whether every locus stays so far below one that finer fractions would yield no angle."""
    angle = sweep_frequencies(plant.A, plant.B @ plant.K) * plant.period_s
    angle = np.union1d(angle[angle < pi * 0.99], np.linspace(0.01, pi - 1e-4, 200))
    loops = (
        delay_loci(F, G, plant.K, D) for F, G, D in (_tustin(plant, k / _FRACTIONS) for k in range(_FRACTIONS + 1))
    )
    omega = np.tan(angle / 2.0) * 2.0 / plant.period_s
    return all(float(np.abs(loci(omega)).max()) < _SMALL for loci in loops)


def _least_delay_off_the_real_axis(plant: SampledPlant, refinement: int) -> float:
    """The least tau >= 0 with an eigenvalue of the one-period map on the unit circle other than +-1."""
    best_s = inf
    for delay_s, angle in sorted(_starts(plant, refinement)):
        if delay_s > best_s + 2.0 * plant.period_s:
            break
        refined_s = _refined(plant, delay_s, angle)
        if 0.0 <= refined_s < best_s:
            best_s = refined_s
    return best_s


def _starts(plant: SampledPlant, refinement: int) -> list[tuple[float, float]]:
    """Delays (s) and angles near every possible first crossing.

    At a fraction m, a crossing with angle phi and locus e^{j theta} has q = theta / phi - 1, which must be whole: a
    crossing lies between two neighbouring m if q passes a whole number between them.
    """
    size = float(np.linalg.norm(plant.A) + np.linalg.norm(plant.B @ plant.K)) * plant.period_s
    count = refinement * int(np.clip(_FRACTIONS * size, _FRACTIONS, 4 * _FRACTIONS))
    fractions = np.arange(count + 1) / count
    found = [_unit_angles(plant, float(m)) for m in fractions]
    starts: list[tuple[float, float]] = []
    # an angle that exists at all fractions has a whole q at each turn of its locus; one that exists at few may not
    turns = 2 if refinement == 1 else _TURNS
    for i in range(count):
        m, step = float(fractions[i]), 1.0 / count
        if len(found[i]) == len(found[i + 1]):
            for (angle, locus), (next_angle, next_locus) in zip(found[i], found[i + 1], strict=True):
                theta, turn = float(np.angle(locus)) % (2.0 * pi), float(np.angle(next_locus / locus))
                for extra in (2.0 * pi * turn for turn in range(-1, turns)):
                    q, next_q = (theta + extra) / angle - 1.0, (theta + extra + turn) / next_angle - 1.0
                    starts += _between(plant, (q, next_q), (angle, next_angle), m, step)
        else:
            # angles appear or vanish within this step: try every one at either end
            for end, list_of_end in ((m, found[i]), (m + step, found[i + 1])):
                for angle, locus in list_of_end:
                    for extra in (2.0 * pi * turn for turn in range(turns)):
                        q = round((float(np.angle(locus)) % (2.0 * pi) + extra) / angle - 1.0)
                        starts += [((q + end) * plant.period_s, angle)] if q >= 0 else []
    return starts


def _between(
    plant: SampledPlant, q: tuple[float, float], angle: tuple[float, float], m: float, step: float
) -> list[tuple[float, float]]:
    """Delay and angle where q passes a whole number >= 0 between m and m + step, by linear interpolation."""
    change = q[1] - q[0]
    # a quarter of the step on either side allows for nonlinearity
    slack = 0.25 * abs(change) + 1e-9
    starts: list[tuple[float, float]] = []
    for whole in range(max(0, ceil(min(q) - slack)), floor(max(q) + slack) + 1):
        part = min(max((whole - q[0]) / change, 0.0), 1.0) if change != 0.0 else 0.5
        starts.append(((whole + m + part * step) * plant.period_s, angle[0] + part * (angle[1] - angle[0])))
    return starts


def _unit_angles(plant: SampledPlant, m: float) -> list[tuple[float, complex]]:
    """Angles 0 < phi < pi at which H_m(e^{j phi}) has an eigenvalue of modulus one, each with this eigenvalue.

    Tustin's map z = (1 + w T/2) / (1 - w T/2) takes the unit circle to the imaginary axis w = j Omega, with
    phi = 2 atan(Omega T / 2) and H_m(z) = D + K (w I - F)^{-1} G, well scaled for any period.
    """
    F, G, D = _tustin(plant, m)
    loci = delay_loci(F, G, plant.K, D)
    if plant.B.shape[1] == 1:
        # |D| = 1 is a crossing at z = -1, found elsewhere
        roots, highest = unit_gain_roots(F, G, plant.K, float(D[0, 0])), 1e5 / plant.period_s
        near_axis = np.abs(roots.real) <= 1e-3 * (np.abs(roots) + float(np.linalg.norm(F)))
        omega = roots.imag[near_axis & (roots.imag > 0.0) & (roots.imag < highest)]
        points = separating_points(np.sort(omega), highest)
    else:
        angle = sweep_frequencies(plant.A, plant.B @ plant.K) * plant.period_s
        angle = np.union1d(angle[angle < pi * 0.99], np.linspace(0.01, pi - 1e-4, 200))
        points = with_extrema(loci, np.tan(angle / 2.0) * 2.0 / plant.period_s)
    return [
        (2.0 * float(np.arctan(crossing.omega * plant.period_s / 2.0)), crossing.locus)
        for crossing in unit_crossings(loci, points)
    ]


def _tustin(plant: SampledPlant, m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """F (n, n), G (n, r), D (r, r) of H_m in the variable w."""
    period_s = plant.period_s
    Phi, hold = plant.transition(np.array([period_s, period_s * (1.0 - m)]))
    newer, older = hold[1], hold[0] - hold[1]
    identity = np.eye(plant.A.shape[0])
    # K [(Phi' + w Phi'')]^-1 (G0 + G1 + w (G0 - G1)) with Phi' = I - Phi, Phi'' = I + Phi, w in units of 2 / T
    solved = np.linalg.solve(identity + Phi[0], np.hstack([Phi[0] - identity, newer + older, newer - older]))
    n, inputs = plant.B.shape
    F, both, difference = solved[:, :n], solved[:, n : n + inputs], solved[:, n + inputs :]
    rate = 2.0 / period_s
    return rate * F, rate * (both + F @ difference), plant.K @ difference


def _refined(plant: SampledPlant, delay_s: float, angle: float) -> float:
    """The delay (s) that `_newton` finds, or one at a whole number of periods, which it can miss.

    The residual has a kink there, so a step may lead away from a solution. A start that already is a solution is
    therefore kept, and one that nearly is a solution is tried again from both sides.
    """
    beside_s = _SAME_PLACE * plant.period_s
    from_whole_s = abs(delay_s - round(delay_s / plant.period_s) * plant.period_s)
    found_s = _newton(plant, delay_s, angle, multiple=from_whole_s > beside_s)
    if abs(found_s - delay_s) < beside_s or from_whole_s > beside_s:
        return found_s
    residual, terms, _ = _residual(plant, delay_s, angle)
    relative = residual / sum(float(np.linalg.norm(term)) for term in terms)
    if _ROUNDING < relative < _SAME_PLACE and np.isnan(found_s):
        return float(np.fmin(_newton(plant, delay_s - beside_s, angle), _newton(plant, delay_s + beside_s, angle)))
    return delay_s if relative <= _ROUNDING else found_s


def _newton(plant: SampledPlant, delay_s: float, angle: float, *, multiple: bool = False) -> float:
    """The delay near `delay_s` at which e^{j phi}, phi near `angle`, is an eigenvalue; nan if there is none near by.

    Near a multiple root steps shrink slowly and stop far above 1e-9. The last iterate then counts if `multiple`.
    """
    start_s, previous = delay_s, inf
    for _ in range(30):
        residual, _, (by_angle, by_delay) = _residual(plant, delay_s, angle)
        determinant = by_angle.real * by_delay.imag - by_angle.imag * by_delay.real
        if determinant == 0.0:
            return np.nan
        step_angle = -residual * by_delay.imag / determinant
        step_s = residual * by_angle.imag / determinant
        angle, delay_s = angle + step_angle, delay_s + step_s
        if not (0.0 < angle < pi and abs(delay_s - start_s) < 2.0 * plant.period_s and delay_s > -plant.period_s):
            return np.nan
        step = abs(step_angle) / angle + abs(step_s) / plant.period_s
        # near 1e-13, rounding stops the steps from shrinking; larger steps that do not shrink do not converge
        if step < 1e-14 or (step < 1e-9 and step >= 0.5 * previous):
            return delay_s
        previous = step
    residual, terms, _ = _residual(plant, delay_s, angle)
    solved = multiple and residual <= _SOLVED * sum(float(np.linalg.norm(term)) for term in terms)
    return delay_s if solved else np.nan


def _residual(
    plant: SampledPlant, delay_s: float, angle: float
) -> tuple[float, tuple[NDArray[Any], ...], tuple[complex, complex]]:
    """The least singular value u*M v of M = z^{q+1} (z I - Phi) - (G0 z + G1) K, the terms of M, and derivatives.

    The derivatives are those of u*M v by phi and tau, u and v being singular; dM / dtau = (z - 1) e^{A (T - e)} B K.
    """
    period_s = plant.period_s
    whole, rest_s = split_delay(delay_s, period_s) if delay_s >= 0.0 else (-1, delay_s + period_s)
    states, hold = plant.transition(np.array([period_s, period_s - rest_s]))
    newer, older = hold[1] @ plant.K, (hold[0] - hold[1]) @ plant.K
    z = np.exp(1j * angle)
    turned = z ** (whole + 1)
    free = z * np.eye(plant.A.shape[0]) - states[0]
    U, singular, Vh = np.linalg.svd(turned * free - newer * z - older)
    u, v = U[:, -1].conj(), Vh[-1].conj()
    by_z = (whole + 1) * turned / z * free + turned * np.eye(len(free)) - newer
    by_delay = (z - 1.0) * complex(u @ states[1] @ plant.B @ (plant.K @ v))
    return float(singular[-1]), (free, newer, older), (1j * z * complex(u @ by_z @ v), by_delay)


def _least_delay_at_minus_one(plant: SampledPlant, refinement: int) -> float:
    """The least tau > 0 with an eigenvalue of the one-period map at z = -1.

    H_m is real there, H_m(-1) = K (I + Phi)^-1 (G0 - G1), and must have the eigenvalue (-1)^{q+1}: one equation for m.
    """
    fractions = np.linspace(0.0, 1.0, 8 * refinement * _FRACTIONS + 1)
    loops = _loops_at_minus_one(plant, fractions)
    if float(np.linalg.norm(loops, axis=(1, 2)).max()) < _FAR_FROM_ONE:
        return inf
    best_s = inf
    identity = np.eye(plant.B.shape[1])
    for whole, sign in ((0, -1.0), (1, 1.0)):

        def determinant(m: FloatArray, sign: float = sign) -> FloatArray:
            return np.linalg.det(identity - sign * _loops_at_minus_one(plant, m))

        values = determinant(fractions)
        # rounding must not hide a root at a whole period from the intervals on both its sides
        values[np.abs(values) < _ROUNDING] = 0.0
        at = np.flatnonzero(np.sign(values[1:]) != np.sign(values[:-1]))
        if at.size > 0:
            m = bracketed_roots(determinant, fractions[at], fractions[at + 1], values[at], values[at + 1])
            best_s = min(best_s, (whole + float(m.min())) * plant.period_s)
    return best_s


def _loops_at_minus_one(plant: SampledPlant, m: FloatArray) -> FloatArray:
    """H_m(-1), shape (k, r, r), for k fractions of a period."""
    states, hold = plant.transition(np.concatenate([[1.0], 1.0 - m]) * plant.period_s)
    return plant.K @ np.linalg.solve(np.eye(plant.A.shape[0]) + states[0], 2.0 * hold[1:] - hold[0])


def _contradiction(plant: SampledPlant, margin_s: float) -> str:
    """Message if the spectral radius of the one-period map below or above the margin contradicts it, else empty."""
    known_s = margin_s if margin_s < inf else 5.0 * plant.period_s
    if plant.A.shape[0] + plant.B.shape[1] * (known_s / plant.period_s + 2.0) > _LARGEST_CHECK:
        return ""
    radii = {fraction: block_radius(plant, fraction * known_s) for fraction in _BELOW}
    above = [fraction for fraction, radius in radii.items() if radius >= 1.0 + _AT_ONE]
    wrong = next((each for each in above if radii[each] >= 1.0 + _radius_error(plant, each * known_s)), None)
    if wrong is None and margin_s < inf:
        radii[_ABOVE], least = block_radius(plant, _ABOVE * known_s), 1.0 - _AT_ONE
        if radii[_ABOVE] < least:
            least = min(least, 1.0 - _radius_error(plant, _ABOVE * known_s))
        # it may touch one at a whole period and be smaller on both sides
        if radii[_ABOVE] < least and block_radius(plant, known_s) < least:
            wrong = _ABOVE
    if wrong is None:
        return ""
    return (
        f"the sampled delay margin is {margin_s} s at a period of {plant.period_s} s, but the spectral radius "
        f"of the one-period map at {wrong * known_s} s is {radii[wrong]}"
    )


def _radius_error(plant: SampledPlant, delay_s: float) -> float:
    """By how much rounding may have moved the spectral radius: far if its eigenvalue is nearly a multiple one."""
    step = lifted_map(plant, delay_s)
    epsilon = len(step) * float(np.finfo(np.float64).eps * np.linalg.norm(step))
    return min(epsilon * sensitivity(step), _MOST_ERROR)
