"""A simple root at s = 0 that stays there at every delay, as the common value of a consensus, and what passes it.

With M(s) = sI - sum_k A_k e^{-s d_k}, M(0) = -sum_k A_k does not depend on the delays: where it is singular, s = 0 is a
root at all of them, whether or not anything stands still on its way (in x' = -x + x(t - tau) nothing does). With
w'M(0) = 0 and M(0) v = 0 the other roots near zero solve

    f(s) / s = w'M'v + s w'(M''/2 - M' G M') v + ...,   M' = I + sum_k d_k A_k,  M'' = -sum_k d_k^2 A_k,

M' and M'' at s = 0 and G any inverse with M(0) G M(0) = M(0). The delays are d_k = known_k + multiple_k tau, so
w'M'v is linear in tau: one real root passes zero, at one delay, or none does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gains.core.arrays import FloatArray, IntArray
from gains.core.structure import is_singular_for_any_delay

# the cosine of the angle between the null vectors of a simple eigenvalue, rounding being far below
_SIMPLE = 1e-6
# a crossing below this share of the highest frequency, and this close to the limit (rad), is the root at zero
_BLUR, _TURN = 1e-3, 1e-3


@dataclass(frozen=True)
class ZeroPassage:
    """A real root passes the one that stays at s = 0 at `delay_s`: to the right, unstable (+1), or to the left (-1).

    `direction` is 0 if none passes at any delay above zero; the delay is then negative or infinite.
    """

    delay_s: float
    direction: int

    def is_seen_at(self, omega: float, theta: float, highest: float) -> bool:
        """Whether a crossing of the angle theta = omega tau is the root at zero, blurred by rounding.

        The locus e^{s tau} of that root is 1 + s delay_s + ..., of modulus one to rounding at low frequencies, where
        there may be any number of crossings in its noise.
        """
        limit = omega * self.delay_s if np.isfinite(self.delay_s) else 0.0
        return omega < _BLUR * highest and abs(float(np.angle(np.exp(1j * (theta - limit))))) < _TURN


def zero_passage(
    matrices: Sequence[FloatArray] | FloatArray, known_s: FloatArray, multiples: IntArray
) -> ZeroPassage | None:
    """What passes the simple root of a block at s = 0, or None if it has no such root at every delay.

    Parameters
    ----------
    matrices, known_s, multiples
        A_k (n, n) in 1/s acts known_s[k] + multiples[k] tau late.

    Examples
    --------
    s = 1 - e^{-s tau}, x' = x - x(t - tau): a root passes zero to the right at tau = 1.

    >>> import numpy as np
    >>> from gains.delay._zero_root import zero_passage
    >>> zero_passage([np.array([[1.0]]), np.array([[-1.0]])], np.zeros(2), np.arange(2))
    ZeroPassage(delay_s=1.0, direction=1)
    """
    terms: FloatArray = np.array(matrices, dtype=np.float64)
    if not terms.any() or not is_singular_for_any_delay(terms):
        return None
    total = terms.sum(axis=0)
    U, singular, Vh = np.linalg.svd(total)
    w, v = U[:, -1], Vh[-1]
    if singular.size > 1 and singular[-2] <= 1e-12 * singular[0]:
        return None

    def weight(factors: FloatArray | IntArray) -> FloatArray:
        return np.tensordot(factors, terms, axes=1)

    slope_known = w @ v + w @ weight(known_s) @ v
    by_delay = float(w @ weight(multiples) @ v)
    # simple without delay at all, and with the known ones: two roots that stay are beyond this
    if min(abs(float(w @ v)), abs(float(slope_known))) < _SIMPLE:
        return None
    delay_s = -float(slope_known) / by_delay if by_delay != 0.0 else np.inf
    if not 0.0 < delay_s < 1e12 / float(np.linalg.norm(terms, axis=(1, 2)).sum()):
        return ZeroPassage(delay_s, 0)
    delays_s = known_s + multiples * delay_s
    first, second = np.eye(len(total)) + weight(delays_s), -weight(delays_s**2)
    kept = singular > 1e-12 * singular[0]
    inverse = -(Vh[kept].T / singular[kept]) @ U[:, kept].T
    curvature = float(w @ (second / 2.0 - first @ inverse @ first) @ v)
    if curvature == 0.0:
        return None
    return ZeroPassage(delay_s, int(np.sign(-by_delay / curvature)))
