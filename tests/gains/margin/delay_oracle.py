"""An oracle for loops with delays that shares nothing with `gains`: it counts roots by the argument principle.

det M(j omega) / (j omega + c)^n winds around zero once for each root of M(s) = sI - sum_k A_k e^{-s d_k} with positive
real part. The winding is added up over steps that cannot hide a turn: M is Lipschitz, L = 1 + sum_k d_k ||A_k||, so
over a step h with h L < rho sigma_min(M) the matrix M' M^{-1} stays within rho of the identity, and each of its n
eigenvalues turns by less than asin(rho). With n asin(rho) < pi the principal angle of the determinant is the turn.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_MOST_POINTS = 100_000


class TooCloseError(Exception):
    """A root is too close to the imaginary axis for the oracle to say on which side it is."""


def unstable_roots(terms: Sequence[tuple[ArrayLike, float]], *, roots_at_zero: int = 0) -> int:
    """Roots with positive real part of x'(t) = sum A x(t - d), terms (A, d); `roots_at_zero` are known and left out."""
    matrices = np.array([np.array(matrix, dtype=np.float64) for matrix, _ in terms])
    delays = np.array([float(delay) for _, delay in terms])
    n = matrices.shape[1]
    norms = np.linalg.norm(matrices, 2, axis=(1, 2))
    scale = float(norms.sum())
    lipschitz = 1.0 + float(delays @ norms)
    rho = min(0.5, float(np.sin(2.5 / n)))

    def characteristic(omega: NDArray[Any]) -> NDArray[Any]:
        turned = np.exp(-1j * omega[:, np.newaxis] * delays) @ matrices.reshape(len(matrices), -1)
        return 1j * omega[:, np.newaxis, np.newaxis] * np.eye(n) - turned.reshape(-1, n, n)

    def look(omega: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        M = characteristic(omega)
        sign = np.linalg.slogdet(M)[0]
        values = sign * np.exp(-1j * n * np.angle(1j * omega + scale))
        values = values * np.exp(1j * roots_at_zero * (np.angle(1j * omega + scale) - np.pi / 2.0))
        return values, np.linalg.svd(M, compute_uv=False)[:, -1]

    first = 1e-6 * scale / lipschitz if roots_at_zero else 0.0
    # beyond the last frequency M is jw (I + E) with ||E|| < 1e-3 / n
    last = 1e3 * n * scale
    omega = np.concatenate([[first], np.geomspace(max(first * 2.0, 1e-6 * scale), last, 400)])
    values, least = look(omega)
    while True:
        reach = np.maximum(least[1:], least[:-1])
        coarse = np.flatnonzero(np.diff(omega) * lipschitz > rho * reach)
        # far out M is jw plus something small, so these steps need no refining
        coarse = coarse[omega[coarse] < 4.0 * n * scale]
        if coarse.size == 0:
            break
        if omega.size > _MOST_POINTS or least.min() < 1e-13 * scale:
            raise TooCloseError(f"{omega.size} points, least singular value {least.min()}")
        between = (omega[coarse] + omega[coarse + 1]) / 2.0
        new_values, new_least = look(between)
        omega = np.insert(omega, coarse + 1, between)
        values, least = np.insert(values, coarse + 1, new_values), np.insert(least, coarse + 1, new_least)
    turn = float(np.angle(values[-1])) - float(np.angle(values[1:] / values[:-1]).sum())
    roots = turn / np.pi
    if abs(roots - round(roots)) > 0.05:
        raise TooCloseError(f"{roots} roots counted")
    return round(roots)
