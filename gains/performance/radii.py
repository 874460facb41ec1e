"""Stability radii at a loop delay: the least disturbance w = Δ e that makes a formation in flight unstable.

The loop is sampled and held, as in `gains.performance.disturbed`. In every period a disturbance is computed from the
true errors of some vehicles, w_k = Δ e_k, and acts on e' = A e + B u + w until the next (3.20-3.24). With M(z) from w
to e, the radius is the least size |Δ| at which det(I − M(z) Δ) = 0 somewhere on the unit circle:

    complex radius   1 / max σ_1(M)     Δ may be any stable filter, with any phase for each error
    real radius      1 / max μ_R(M)     Δ is a constant matrix, the same on each axis

    μ_R(M) = inf over 0 < γ ≤ 1 of σ_2 [[Re M, −γ Im M], [Im M / γ, Re M]],

by the formula of Qiu, Bernhardsson, Rantzer, Davison, Young and Doyle, "A formula for computation of the real stability
radius", Automatica 31(6), 1995; where z is real, μ_R is σ_1(M). For a single error M is a number: μ_R is |M| where M is
real, and 0 elsewhere. A constant Δ that couples two axes acts like a complex one on one axis, so the complex radius is
also that of constant disturbances of north and east together.

Both radii are returned with the worst Δ. The complex one has rank one, and first-order all-pass filters (c + 1/z) /
(1 + c/z) give its entries their phases at the worst frequency, so its size is the same at all other frequencies.
"""

from dataclasses import dataclass
from math import ceil, inf, pi, tau

import numpy as np

from gains.core._bracketing import Functions, bracketed_roots, highest, peaks
from gains.core.arrays import ComplexArray, FloatArray, spectral_norms
from gains.core.errors import BadModelError
from gains.performance.disturbed import DisturbedFormation
from gains.sampled._loop import HeldPlant

# number of angles in the first scan, the least of them, and the lower end of log γ
_ANGLES, _LEAST_ANGLE, _LEAST_LOG_GAMMA = 400, 1e-5, -14.0
_GAMMAS = 25
# angles per radian by which late commands rotate M; offsets from each resonance in units of its width
_PER_RADIAN, _BESIDE = 8, np.concatenate([way * 2.0 ** np.arange(-3.0, 10.0) for way in (-1.0, 1.0)])
# entries this small in the unit vectors of the worst disturbance are zero
_NOTHING = 1e-9
_ROTATIONS = 180


@dataclass(frozen=True, eq=False)
class Worst:
    """A stability radius, and a disturbance of that size that makes the loop unstable.

    w = radius · out(z) D in(z) e, with D = `direction` of norm one, and the coefficients c of an all-pass filter for
    each column (in) and row (out); c = 1 leaves an error unchanged.
    """

    radius_1_s: float
    """`inf` if no disturbance of these errors makes the loop unstable; the others are then empty."""
    frequency_rad_s: float
    direction: FloatArray
    all_pass_in: tuple[float, ...] = ()
    all_pass_out: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class SectorLoop:
    """The loop of a formation of one axis, and the errors (indices in e) from which w is computed and on which it acts.

    A vehicle alone, x' = −x + w sampled at 1 kHz, becomes unstable at w = x:

    >>> from gains.formation.model import FormationModel
    >>> leader = FormationModel((-1,), axes=1)
    >>> loop = SectorLoop(DisturbedFormation(leader, leader.A, leader.B, np.array([[-1.0]]), 0.001, 0.0), (0,))
    >>> round(loop.complex_radius().radius_1_s, 9), round(loop.real_radius().radius_1_s, 9)
    (1.0, 1.0)
    """

    formation: DisturbedFormation
    errors: tuple[int, ...]
    weight: FloatArray | None = None
    """W of w = Δ W e, (errors, errors); None for the identity."""

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """M at frequencies (k,), from a held w to weighted e, (k, errors, errors)."""
        z = np.exp(1j * omega_rad_s * self.formation.period_s)[:, np.newaxis, np.newaxis].astype(np.complex128)
        chosen = list(self.errors)
        M = (self.formation.closed(z)[:, chosen] @ self._entry).astype(np.complex128)
        return M if self.weight is None else self.weight @ M

    def complex_radius(self) -> Worst:
        """The least size of a disturbance that may be any stable filter."""

        def largest(omega: FloatArray) -> FloatArray:
            return spectral_norms(self.response(omega))

        omega, peak = self._peak(largest, np.zeros(0), np.zeros(0))
        if peak <= 0.0:
            return Worst(inf, 0.0, np.zeros((0, 0)))
        left, _, right = np.linalg.svd(self.response(np.array([omega]))[0])
        return self._filtered(1.0 / peak, omega, left[:, 0], right[0].conj())

    def real_radius(self) -> Worst:
        """The least size of a constant disturbance, the same on each axis."""
        ends = np.array([0.0, pi / self.formation.period_s])
        if len(self.errors) == 1:
            return self._real_radius_of_one(ends)
        at_ends = spectral_norms(self.response(ends).real)

        def largest(omega: FloatArray) -> FloatArray:
            M = self.response(omega)
            values = spectral_norms(M)  # μ_R is no larger
            if (likely := values > at_ends.max()).any():
                values[likely] = _real_measure(M[likely])[0]
            return values

        omega, peak = self._peak(largest, ends, at_ends)
        if peak <= 0.0:
            return Worst(inf, 0.0, np.zeros((0, 0)))
        [M] = self.response(np.array([omega]))
        if omega in ends:
            left, _, right = np.linalg.svd(M.real)
            return Worst(1.0 / peak, omega, np.outer(right[0], left[:, 0]))
        direction = _worst_constant(M, float(_real_measure(M[np.newaxis])[1][0]))
        return Worst(1.0 / peak, omega, direction)

    def _real_radius_of_one(self, ends: FloatArray) -> Worst:
        """Real radius for a single error: M is real at the ends, and where Im M changes sign on a fine grid."""

        def imaginary(omega: FloatArray) -> FloatArray:
            return self.response(omega)[:, 0, 0].imag

        T = self.formation.period_s
        z = np.linalg.eigvals(self.formation.period_map())
        angles, widths = np.abs(np.angle(z)), 1.0 - np.abs(z)
        beside = (angles[:, np.newaxis] + widths[:, np.newaxis] * _BESIDE).ravel()
        late = max(float(np.max(self.formation.delay_s)), self.formation.assumed_s or 0.0) / T
        evenly = np.linspace(0.0, pi, ceil(_PER_RADIAN * pi * (late + 2.0)))
        grid = np.concatenate([np.geomspace(_LEAST_ANGLE, pi, _ANGLES), evenly, angles, beside])
        grid = np.unique(grid[(grid > 0.0) & (grid < pi * (1.0 - 1e-9))]) / T
        values = imaginary(grid)
        k = np.flatnonzero(values[:-1] * values[1:] < 0.0)
        passed = bracketed_roots(imaginary, grid[k], grid[k + 1], values[k], values[k + 1])
        omega = np.concatenate([ends, passed])
        M = self.response(omega)[:, 0, 0].real
        best = int(np.argmax(np.abs(M)))
        if M[best] == 0.0:
            return Worst(inf, 0.0, np.zeros((0, 0)))
        return Worst(1.0 / float(np.abs(M[best])), float(omega[best]), np.sign(M[best]).reshape(1, 1))

    @property
    def _entry(self) -> FloatArray:
        """Effect of a held w of these errors on the states over one period, (states, errors)."""
        formation = self.formation
        size, T = len(formation.A), formation.period_s
        if formation.gusts is not None:
            raise BadModelError("gusts are given; wanted a formation that nothing but w disturbs")
        acts = np.eye(size)[:, list(self.errors)]
        return HeldPlant(formation.A, acts, acts.T, T).transition(np.array([T]))[1][0]

    def _peak(self, function: Functions, more: FloatArray, values: FloatArray) -> tuple[float, float]:
        """Frequency and height of the largest value, local maxima refined; at `more` frequencies values are given."""
        T = self.formation.period_s
        grid = np.geomspace(_LEAST_ANGLE, pi * (1.0 - 1e-9), _ANGLES) / T
        grid = np.unique(np.concatenate([[0.0] if not more.size else [], grid, self._resonances()]))
        known = zip(more.tolist(), values.tolist(), strict=True)
        return max([*known, highest(function, grid)], key=lambda each: each[1])

    def _resonances(self) -> FloatArray:
        """Frequencies (rad/s) of the loop's own motions, where peaks may be narrow."""
        z = np.linalg.eigvals(self.formation.period_map())
        omega = np.abs(np.angle(z[np.abs(z) > 0.5])) / self.formation.period_s
        return omega[(omega > 0.0) & (omega < (1.0 - 1e-9) * pi / self.formation.period_s)]

    def _filtered(self, radius: float, omega: float, left: ComplexArray, right: ComplexArray) -> Worst:
        """The rank-one v u* as all-pass filters at an angle; a free common phase is chosen to make them fast."""
        angle = omega * self.formation.period_s
        sizes = np.outer(np.abs(right), np.abs(left))
        if angle == 0.0 or angle >= pi * (1.0 - 1e-6):
            return Worst(radius, omega, np.outer(right.real, left.real))
        turns = np.exp(1j * np.linspace(0.0, pi, _ROTATIONS, endpoint=False))[:, np.newaxis]
        signs, filters, largest = list[FloatArray](), list[FloatArray](), list[FloatArray]()
        for vector, way in ((right, +1), (left, -1)):
            sign, c = _all_pass(way * np.angle(vector * turns), angle)
            none = np.abs(vector) <= _NOTHING
            signs.append(np.where(none, 1.0, sign))
            filters.append(np.where(none, 1.0, c))
            largest.append(np.where(none, 0.0, np.abs(c)).max(axis=1))
        best = int(np.argmin(np.maximum(*largest)))
        direction = sizes * np.outer(signs[0][best], signs[1][best])
        return Worst(radius, omega, direction, tuple(filters[1][best].tolist()), tuple(filters[0][best].tolist()))


def _all_pass(phase: FloatArray, angle: float) -> tuple[FloatArray, FloatArray]:
    """Signs s and coefficients c with s (c + e^{−jθ}) / (1 + c e^{−jθ}) = e^{j phase} at θ = angle in (0, π)."""
    lag = np.mod(-phase, tau)
    sign = np.where(lag < pi, 1.0, -1.0)
    lag = np.mod(lag, pi)
    return sign, np.sin((angle - lag) / 2.0) / np.sin((angle + lag) / 2.0)


def _doubled(M: ComplexArray, gamma: FloatArray) -> FloatArray:
    """[[Re M, −γ Im M], [Im M / γ, Re M]] for each of M (k, n, n) and γ (k,)."""
    g = gamma[:, np.newaxis, np.newaxis]
    above = np.concatenate([M.real, -g * M.imag], axis=2)
    return np.concatenate([above, np.concatenate([M.imag / g, M.real], axis=2)], axis=1)


def _real_measure(M: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """μ_R of each of M (k, n, n), and the γ at which it is attained. σ_2 has one minimum over log γ."""

    def minus(log_gamma: FloatArray) -> FloatArray:
        values = np.linalg.svd(_doubled(M, np.exp(log_gamma)), compute_uv=False)
        return -values[:, 1].astype(np.float64)

    logs = np.linspace(_LEAST_LOG_GAMMA, 0.0, _GAMMAS)
    looked = np.stack([minus(np.full(len(M), each)) for each in logs])
    best = np.argmax(looked, axis=0)
    low, high = logs[np.maximum(best - 1, 0)], logs[np.minimum(best + 1, _GAMMAS - 1)]
    at = peaks(minus, low, high)
    values, ends = minus(at), looked[best, np.arange(len(M))]
    gamma = np.where(values >= ends, at, logs[best])
    return -np.maximum(values, ends), np.exp(gamma)


def _worst_constant(M: ComplexArray, gamma: float) -> FloatArray:
    """The real Δ of least norm with det(I − M Δ) = 0, scaled to norm one.

    With P v = σ u, M (v_1 + jγ v_2) = σ (u_1 + jγ u_2): Δ takes σ u_1 to v_1 and σ u_2 to v_2. It has the norm 1 / σ if
    |u_1| = |v_1| and u_1'u_2 = v_1'v_2. The first holds where σ_2 is stationary in γ, or for some combination of the
    vectors of two singular values that meet in the minimum; the second follows from P v = σ u and P'u = σ v.
    """
    left, values, right = np.linalg.svd(_doubled(M[np.newaxis], np.array([gamma]))[0])
    n, pair = len(M), 0 if values[0] - values[1] < values[1] - values[2] else 2

    def excess(j: int, k: int) -> float:
        return float(left[:n, j] @ left[:n, k] - right[j, :n] @ right[k, :n])

    # rotated by t in the pair: excess(1, 1) cos² t + 2 excess(1, pair) cos t sin t + excess(pair, pair) sin² t = 0
    single, both, other = excess(1, 1), excess(1, pair), excess(pair, pair)
    size, turn = np.hypot((single - other) / 2.0, both), np.arctan2(both, (single - other) / 2.0)
    opening = np.arccos(np.clip(-(single + other) / (2.0 * size), -1.0, 1.0)) if size > 0.0 else 0.0
    found: list[tuple[float, FloatArray]] = []
    for at in (0.0, (turn + opening) / 2.0, (turn - opening) / 2.0):
        u, v = (np.cos(at) * w[1] + np.sin(at) * w[pair] for w in (left.T, right))
        direction = np.stack([v[:n], v[n:]], axis=1) @ np.linalg.pinv(np.stack([u[:n], u[n:]], axis=1))
        found.append((float(np.linalg.norm(direction, 2)), direction))
    size, direction = min(found, key=lambda each: abs(each[0] - 1.0))
    return direction / size
