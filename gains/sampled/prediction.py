"""Delay compensation by prediction over an assumed loop delay, and the true delays that the loop tolerates.

The station knows each command it has sent. It propagates the newest sample, under the commands that act after it, to
the instant at which the new command acts if the loop delay is tau^, and feeds back the predicted state:

    x^(t_k + tau^) = Phi(tau^) x_k + sum_j Gamma_j u_{k-j},   u_k = K x^(t_k + tau^),
    Phi(t) = e^{A t},   Gamma_j = int Phi(tau^ - s) B ds over [tau^ - j T, tau^ - (j - 1) T] within [0, tau^]

If tau^ equals the true loop delay tau, the loop behind the delay is the loop without delay. Otherwise the mismatch
tau - tau^ limits it: the *mismatch window* is the interval of true delays around tau^ in which it is stable. Every tick
predicts, so a command counts even if its sample has been used before. Loop delays are defined as in `multirate`.

In continuous time u(t) = K (e^{A tau^} x(t) + int_0^tau^ e^{A s} B u(t - s) ds) gives x'(t) = A x(t) + B u(t - tau)
the roots of

    det(s I - A - B K - B K e^{A tau^} (e^{-s tau} - e^{-s tau^})) = 0,

a loop with two delays, one of them known. A vehicle's telemetry does not contain its acceleration: the station computes
it from the commands alone, and e^{A tau^} then acts only on `measured` states, see `HeldPlant.carry`. Robustness and
string stability are in `gains.criteria.predicted`. Source:
Z. Artstein, "Linear systems with delayed controls: a reduction", IEEE Trans. AC 27 (1982).
"""

from collections.abc import Sequence
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import BoolArray, FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import of_type, seconds, shown
from gains.sampled._continuous_mismatch import continuous_crossings
from gains.sampled._loop import held_blocks, rate_of
from gains.sampled._mismatch import common_window
from gains.sampled.constant import checked_loop
from gains.sampled.multirate import Predictor, Timing, lifted_radius


def mismatch_window(
    A: ArrayLike,
    B: ArrayLike,
    K: ArrayLike,
    timing: Timing,
    *,
    assumed_s: float,
    measured: Sequence[bool] | None = None,
) -> tuple[float, float]:
    """The least and the largest true loop delay (s) between which the predicted loop is stable.

    The first is 0 if the loop is stable down to zero delay, the second `inf` if no upper limit is found; both are
    `assumed_s` if the loop is unstable without mismatch. The ends are crossings of the unit circle to about 1e-9 s, or
    to the q-th root of 1e-14 at a q-fold eigenvalue, as of q equal followers in mixed coordinates. Each is confirmed on
    either side by the spectrum of the map of one common period, or by Nyquist's criterion if that map is large. That no
    delay between them is unstable is the result of a search, not a proof: see `gains.sampled._mismatch`.

    A (n, n), B (n, p) and K (p, n) are real, with the feedback u = +K x; a response of the vehicles is part of A and B,
    see `gains.performance.response.formation_loop`. `assumed_s` is tau^, the (mean) loop delay of the prediction.
    `measured` flags the states that are sampled, all if None; the station computes the others from its commands alone.
    K must not use these others, and they must not depend on sampled states. BadModelError names an argument that does
    not fit; DisagreementError is raised if a window ends where no eigenvalue is found on the unit circle.

    x' = u, u = -x has a margin of 1.56 s at 50 Hz. With a station that assumes 3 s it is stable from 1.45 to 4.77 s:

    >>> [round(end_s, 3) for end_s in mismatch_window([[0]], [[1]], [[-1]], Timing(0.02, 0.02), assumed_s=3.0)]
    [1.449, 4.765]
    """
    loop, late_s = checked_loop(A, B, K), seconds("assumed_s", assumed_s)
    common_s = of_type("timing", timing, Timing).common_s
    plants = held_blocks(*loop, period_s=common_s, measured=checked_mask(loop, measured))
    return common_window(plants, timing, late_s)


def mismatch_window_continuous(
    A: ArrayLike, B: ArrayLike, K: ArrayLike, *, assumed_s: float, measured: Sequence[bool] | None = None
) -> tuple[float, float]:
    """The mismatch window of the continuous loop. A hold counts as half a period in both delays.

    The frequencies come from a sweep of loci: a search, not a proof. Arguments as for `mismatch_window`; BadModelError
    names one that does not fit.

    For x' = u, u = -x the characteristic equation is s + 1 + e^{-s tau} - e^{-3 s} = 0:

    >>> [round(end_s, 3) for end_s in mismatch_window_continuous([[0]], [[1]], [[-1]], assumed_s=3.0)]
    [1.386, 4.873]
    """
    loop, late_s = checked_loop(A, B, K), seconds("assumed_s", assumed_s)
    plants = held_blocks(*loop, period_s=1.0, measured=checked_mask(loop, measured))
    if max(float(np.linalg.eigvals(plant.A + plant.B @ plant.K).real.max()) for plant in plants) >= 0.0:
        return late_s, late_s
    aside_s = np.concatenate([continuous_crossings(plant, late_s)[1] for plant in plants])
    shorter_s, longer_s = aside_s[aside_s < 0.0], aside_s[aside_s > 0.0]
    return max(0.0, late_s + float(shorter_s.max(initial=-late_s))), late_s + float(longer_s.min(initial=inf))


def predicted_growth_rate(
    A: ArrayLike,
    B: ArrayLike,
    K: ArrayLike,
    timing: Timing,
    *,
    assumed_s: float,
    delay_s: float,
    measured: Sequence[bool] | None = None,
) -> float:
    """Exponential rate (1/s) of the slowest motion at a true loop delay: negative when stable.

    Arguments as for `mismatch_window`; BadModelError names one that does not fit.

    For x' = u, u = -x without mismatch, the rate is that without delay, ln(1 - T) / T:

    >>> round(predicted_growth_rate([[0]], [[1]], [[-1]], Timing(0.5, 0.5), assumed_s=3.2, delay_s=3.2), 6)
    -1.386294
    """
    loop, late_s = checked_loop(A, B, K), seconds("assumed_s", assumed_s)
    common_s = of_type("timing", timing, Timing).common_s
    plants = held_blocks(*loop, period_s=common_s, measured=checked_mask(loop, measured))
    radii = [lifted_radius(own, timing, delay_s=delay_s, predictor=Predictor(own, late_s)) for own in plants]
    return rate_of(max(radii), common_s)


def checked_mask(loop: tuple[FloatArray, FloatArray, FloatArray], measured: Sequence[bool] | None) -> BoolArray | None:
    """Mask (n,) of the measured states, None if all are; BadModelError if it does not fit the loop."""
    A, _, K = loop
    try:
        mask = None if measured is None else np.array(measured, dtype=np.bool_)
    except ValueError as error:
        raise BadModelError(f"measured is {shown(measured)}; {len(A)} flags are wanted") from error
    if mask is None or mask.all():
        return None
    if mask.shape != (len(A),) or K[:, ~mask].any() or A[np.ix_(~mask, mask)].any():
        wanted = f"{len(A)} flags are wanted, such that K uses measured states only and no other state depends on these"
        raise BadModelError(f"measured is {mask.tolist()}; {wanted}")
    return mask
