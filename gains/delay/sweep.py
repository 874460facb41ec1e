"""Delay margins by sweeps: second opinions that share no algebra with `gains.delay.constant`. Searches, not proofs.

P. R. Sahoo, "Decentralized Control Design Approaches for Formation Control of Unmanned Aerial Vehicles", M.Tech
thesis, NIT Rourkela, 2012, Theorem 2: with A0 + A1 Hurwitz, the margin is the least theta / omega over all omega > 0
with a generalised eigenvalue lambda(j omega I - A0, A1) = e^{-j theta}.
"""

from collections.abc import Sequence
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import FloatArray
from gains.core.structure import balanced, distinct_blocks, square_matrices
from gains.delay._commensurate import circle_loci, circle_points, passes_zero
from gains.delay._loci import delay_loci, norm_of, sweep_frequencies, swept_crossings, unit_crossings

# a root of A(theta) this close to the imaginary axis, relative to the norm, is on it
_ON_AXIS = 1e-9


def frequency_sweep_margin(A0: ArrayLike, A1: ArrayLike) -> float:
    """Delay margin (s) of x'(t) = A0 x(t) + A1 x(t - tau) by a frequency sweep, refined where a modulus is near one.

    0 if A0 + A1 is not Hurwitz, `inf` if no modulus reaches one. The sweep is dense near the natural frequencies of
    A0 and of A0 + A1, and refines every local extremum of a sorted modulus that is near one. A0 and A1 are real
    matrices (n, n) in 1/s; BadModelError unless they are square, finite and of one size.

    >>> round(frequency_sweep_margin([[0]], [[-1]]), 6)  # pi / 2
    1.570796
    """
    blocks = distinct_blocks(*square_matrices(A0=A0, A1=A1))
    return min(_frequency_margin(*balanced(*block.matrices)) for block in blocks)


def circle_sweep_margin(matrices: Sequence[ArrayLike]) -> float:
    """Delay margin (s) of x'(t) = sum_k A_k x(t - k tau) by a sweep along the unit circle.

    Where an eigenvalue s of A(theta) = sum_k A_k e^{-j k theta} crosses the imaginary axis at j omega, tau = theta /
    omega is critical. Sorted real parts are continuous in the angle, so crossings can be bracketed, and local extrema
    near zero are refined. 0 if the loop is unstable without delay, `inf` if no crossing is found. BadModelError unless
    the matrices are square, finite and of one size.
    """
    checked = square_matrices(**{f"matrices[{k}]": matrix for k, matrix in enumerate(matrices)})
    return min(_circle_margin(balanced(*block.matrices)) for block in distinct_blocks(*checked))


def _frequency_margin(A0: FloatArray, A1: FloatArray) -> float:
    if float(np.max(np.linalg.eigvals(A0 + A1).real)) >= 0.0:
        return 0.0
    if not A1.any():
        return inf
    loci = delay_loci(A0, A1, np.eye(A0.shape[0]))
    # an angle just below zero would belong to a root on the axis at zero delay, which A0 + A1 Hurwitz excludes
    return min((crossing.delay_s for crossing in swept_crossings(loci, sweep_frequencies(A0, A1))), default=inf)


def _circle_margin(terms: Sequence[FloatArray]) -> float:
    if float(np.linalg.eigvals(sum(terms, np.zeros_like(terms[0]))).real.max()) >= 0.0:
        return 0.0
    if not any(matrix.any() for matrix in terms[1:]):
        return inf
    scale, loci = norm_of(terms), circle_loci(terms)
    angles = np.array([crossing.omega for crossing in unit_crossings(loci, circle_points(terms))])
    margin_s = inf
    # several roots may cross at nearly one angle (all, if no term acts without delay): take all that are on the axis
    for theta, row in zip(angles.tolist(), np.log(loci(angles)) * scale if angles.size > 0 else (), strict=True):
        for root in row[np.abs(row.real) <= max(_ON_AXIS * scale, float(np.abs(row.real).min()))].tolist():
            # -j omega belongs to the angle -theta
            if not passes_zero(terms, theta, abs(root.imag)):
                margin_s = min(margin_s, (theta if root.imag > 0.0 else 2.0 * pi - theta) / abs(root.imag))
    return margin_s
