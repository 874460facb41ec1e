"""The thesis's frequency sweep: a second opinion on the delay margin that shares no algebra with the first.

P. R. Sahoo, "Decentralized Control Design Approaches for Formation Control of Unmanned Aerial Vehicles", M.Tech
thesis, NIT Rourkela, 2012, Theorem 2: with A0 + A1 Hurwitz, the margin is the least theta / omega over all omega > 0
with a generalised eigenvalue lambda(j omega I - A0, A1) = e^{-j theta}. Here the generalised eigenvalues are computed
as the reciprocals of the eigenvalues of (j omega I - A0)^{-1} A1.
"""

from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike

from gains.core._bracketing import may_reach_zero, peaks
from gains.core.arrays import FloatArray
from gains.core.structure import balanced, distinct_blocks, square_matrices
from gains.delay._loci import Loci, delay_loci, log_moduli, unit_crossings, without_limits_at_zero

# points a decade; a peak of damping ratio 0.01 is 0.009 decades wide
_POINTS_PER_DECADE = 60
_DECADES = 9
# a modulus peak is searched when its sampled height is this close to one (log): sampled peaks are flat by far less
_NEAR_UNIT = 1.0


def frequency_sweep_margin(A0: ArrayLike, A1: ArrayLike) -> float:
    """Delay margin (s) of x'(t) = A0 x(t) + A1 x(t - tau) by a frequency sweep, refined where a modulus is near one.

    0 when A0 + A1 is not Hurwitz, `inf` when no modulus reaches one. The sweep is dense near the natural frequencies
    of A0 and of A0 + A1, and every local extremum of every sorted modulus near one is located, so that two crossings
    between neighbouring grid points are seen. It is a search, not a proof.

    Parameters
    ----------
    A0, A1
        Real matrices (n, n), 1/s.

    Raises
    ------
    BadModelError
        The matrices are not square, finite and of one size.

    Examples
    --------
    x'(t) = -x(t - tau) is stable up to tau = pi / 2:

    >>> from gains.delay.sweep import frequency_sweep_margin
    >>> round(frequency_sweep_margin([[0]], [[-1]]), 6)
    1.570796
    """
    blocks = distinct_blocks(*square_matrices(A0=A0, A1=A1))
    return min(_block_margin(*balanced(*block.matrices)) for block in blocks)


def sweep_frequencies(A0: FloatArray, A1: FloatArray) -> FloatArray:
    """Ascending frequencies (rad/s) up to the bound of every crossing frequency, dense around resonances."""
    highest = 1.1 * float(np.linalg.norm(A0 - A0.T) / 2.0 + np.linalg.norm(A1))
    grid = [highest * np.logspace(-_DECADES, 0.0, _DECADES * _POINTS_PER_DECADE)]
    roots = np.concatenate([np.linalg.eigvals(A0), np.linalg.eigvals(A0 + A1)])
    offsets = np.sinh(np.linspace(-5.0, 5.0, 41))
    for root in roots[roots.imag > 0.0]:
        width = max(abs(root.real), 1e-6 * abs(root.imag))
        grid.append(root.imag + width * offsets)
    # away from the pole itself, where the resolvent does not exist
    omega = np.unique(np.concatenate(grid)) * (1.0 + 1e-9)
    return omega[(omega > 0.0) & (omega <= highest)]


def _block_margin(A0: FloatArray, A1: FloatArray) -> float:
    if float(np.max(np.linalg.eigvals(A0 + A1).real)) >= 0.0:
        return 0.0
    if not A1.any():
        return inf
    loci = delay_loci(A0, A1, np.eye(A0.shape[0]))
    omega = sweep_frequencies(A0, A1)
    omega = np.union1d(omega, near_unit_extrema(loci, omega))
    # e^{j theta} is the locus, so the delay is its angle in [0, 2 pi) over the frequency; an angle a rounding error
    # below zero would belong to a root on the axis at zero delay, which A0 + A1 Hurwitz excludes
    crossings = without_limits_at_zero(loci, unit_crossings(loci, omega), float(omega[-1]))
    return min((float(np.angle(c.locus)) % (2.0 * pi) / c.omega for c in crossings), default=inf)


def near_unit_extrema(loci: Loci, omega: FloatArray, *, near: float = _NEAR_UNIT) -> FloatArray:
    """Frequencies of local extrema of the sorted log moduli that may reach zero between grid points.

    Extrema whose sampled log modulus is `near` or more away from zero are taken not to reach it.
    """
    logs = log_moduli(loci(omega))
    peak, valley = may_reach_zero(omega, logs), may_reach_zero(omega, -logs)
    row, rank = np.nonzero((peak | valley) & (np.abs(logs[1:-1]) < near))
    if row.size == 0:
        return np.empty(0)
    sign = np.where(peak[row, rank], 1.0, -1.0)

    def height(at: FloatArray) -> FloatArray:
        return sign * log_moduli(loci(at))[np.arange(at.size), rank]

    return peaks(height, omega[row], omega[row + 2])
