"""Norms of a loop with delay: H∞ gain of any frequency response, H2 gain of the sampled and held loop."""

from collections.abc import Callable

import numpy as np

from gains.core._bracketing import highest
from gains.core.arrays import ComplexArray, FloatArray, spectral_norms
from gains.sampled._loop import HeldPlant, lifted_map, settled_covariance
from gains.sampled.constant import spectral_radius


def peak_gain(
    characteristic: Callable[[FloatArray], ComplexArray],
    B: FloatArray,
    C: FloatArray,
    frequencies: FloatArray,
    *,
    D: FloatArray | None = None,
) -> float:
    """Return the H∞ gain, the largest singular value of C M(jω)^{-1} B + D over all frequencies (rad/s).

    `characteristic` maps frequencies (k,) to M(jω) (k, n, n), which is sI minus everything that acts on the state.
    `frequencies` must ascend and show every peak; each peak is refined. The result is valid only for a stable loop.

    x' = −x(t − 0.5) + w, z = x + w has gain 2 at ω = 0:

    >>> rest = lambda omega: (1j * omega + np.exp(-0.5j * omega))[:, None, None]
    >>> one = np.eye(1)
    >>> round(peak_gain(rest, one, one, np.linspace(0.0, 5.0, 100), D=one), 9)
    2.0
    """
    through = 0.0 if D is None else D

    def gain(omega: FloatArray) -> FloatArray:
        response = C @ np.linalg.solve(characteristic(omega), B.astype(np.complex128)) + through
        return spectral_norms(response)

    return highest(gain, frequencies)[1]


def noise_gain(A: FloatArray, B: FloatArray, K: FloatArray, *, period_s: float, delay_s: float) -> float:
    """Return the largest standard deviation of a command if every state is measured with unit white noise.

    u_k = K (x(t_k) + n_k) acts from t_k + `delay_s` for a period. n_k is independent from sample to sample and from
    state to state, so the result is the H2 gain of the sampled loop to its noisiest command, `inf` if it is not
    asymptotically stable. Arguments and exceptions as for `gains.sampled.constant.period_map`.

    With x_{k+1} = 0.5 x_k − 0.5 n_k and u = −(x + n), x has the variance 0.25 / (1 − 0.25) and u 1 more:

    >>> round(noise_gain(np.zeros((1, 1)), np.eye(1), -np.eye(1), period_s=0.5, delay_s=0.0) ** 2, 9)
    1.333333333
    """
    # noise may not excite an unstable motion, and at the stability limit the covariance only grows without bound
    if spectral_radius(A, B, K, period_s=period_s, delay_s=delay_s) >= 1.0:
        return float("inf")
    n = len(A)
    loop = lifted_map(HeldPlant(A, B, K, period_s), delay_s)
    entry = (loop - lifted_map(HeldPlant(A, B, 0.0 * K, period_s), delay_s))[:, :n]
    covariance = settled_covariance(loop, entry @ entry.T)
    if covariance is None:
        return float("inf")
    return float(np.diag(K @ (covariance[:n, :n] + np.eye(n)) @ K.T).max() ** 0.5)
