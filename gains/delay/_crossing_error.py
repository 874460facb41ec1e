"""How well a crossing of the imaginary axis is known, from its own sensitivity to rounding.

Methods in double precision blur a multiple root alike, however well they agree with each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.structure import balanced, distinct_blocks

# backward error of a crossing, in units of n eps and the norm: rounding of the matrices, a similarity, an eigenvalue
_BACKWARD = 2.0
# singular values below this, relative to the largest, belong to roots that cross at one place
_TOGETHER = 1e-6


@dataclass(frozen=True, eq=False)
class DelayedTerm:
    """A x(t - known_s - multiple * tau): `matrix` A (n, n) in 1/s, `multiple` whole."""

    matrix: FloatArray
    known_s: float
    multiple: int

    def delay_s(self, tau_s: float) -> float:
        """The delay (s) at one value of the unknown."""
        return self.known_s + self.multiple * tau_s


def crossing_error(terms: Sequence[DelayedTerm], omega: float, tau_s: float) -> tuple[float, float]:
    """Estimated errors of the frequency omega (rad/s) and of the delay tau (s) of a crossing, by its sensitivity.

    With the singular vectors u, v of the least singular value of M(j omega, tau), a change of M by E of norm
    epsilon moves the crossing by the solution of a d omega + b d tau = -u*E v, a = u*(dM/d omega) v and
    b = u*(dM/d tau) v: two real equations. Near a root of multiplicity m u and v become orthogonal and a and b small;
    what is found then is capped by epsilon^(1/n), which no multiplicity exceeds.

    Examples
    --------
    x'(t) = -x(t - tau), known to rounding:

    >>> import numpy as np
    >>> from gains.delay._crossing_error import DelayedTerm, crossing_error
    >>> omega_error, delay_error_s = crossing_error([DelayedTerm(np.array([[-1.0]]), 0.0, 1)], 1.0, np.pi / 2.0)
    >>> delay_error_s < 1e-14
    True
    """
    delays_s, multiples = np.array([term.delay_s(tau_s) for term in terms]), np.array([t.multiple for t in terms])
    worst, least = (0.0, 0.0), inf
    for block in distinct_blocks(*(term.matrix for term in terms)):
        matrices = np.array(balanced(*block.matrices))
        n = matrices.shape[1]
        turned = np.exp(-1j * omega * delays_s)[:, np.newaxis, np.newaxis] * matrices
        M = 1j * omega * np.eye(n) - turned.sum(axis=0)
        U, singular, Vh = np.linalg.svd(M)
        scale = omega + float(np.linalg.norm(matrices, axis=(1, 2)).sum())
        if scale == 0.0 or singular[-1] / scale > least:
            continue
        least = float(singular[-1] / scale)
        near = slice(min(n - 1, int(np.count_nonzero(singular > _TOGETHER * scale))), n)
        by_s = np.eye(n) + np.tensordot(delays_s, turned, axes=1)
        # of roots that cross together, the one that moves most
        left, _, right = np.linalg.svd(U[:, near].conj().T @ by_s @ Vh[near].conj().T)
        u, v = (U[:, near] @ left[:, -1]).conj(), Vh[near].conj().T @ right[-1].conj()
        by_omega = 1j * complex(u @ by_s @ v)
        by_tau = 1j * omega * complex(u @ np.tensordot(multiples, turned, axes=1) @ v)
        epsilon = _BACKWARD * n * float(np.finfo(np.float64).eps) * scale
        determinant = abs((by_omega.conjugate() * by_tau).imag)
        if omega == 0.0:
            # a real root passes the one at zero: the delay is a ratio of two numbers
            worst = (0.0, tau_s * epsilon / scale / max(abs(complex(u @ v)), 1e-300))
            continue
        cap = (epsilon / scale) ** (1.0 / max(n, 2))
        found = [epsilon * abs(by) / determinant if determinant > 0.0 else inf for by in (by_tau, by_omega)]
        worst = min(found[0], cap * omega), min(found[1], cap * max(tau_s, 1.0 / omega))
    return worst
