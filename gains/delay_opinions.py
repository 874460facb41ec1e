"""The delay margin by three methods that share nothing but the splitting into blocks."""

from math import isfinite

import numpy as np
from numpy.typing import ArrayLike

from gains.delay import delay_margin
from gains.delay_sweep import frequency_sweep_margin
from gains.errors import DisagreementError
from gains.rightmost import rightmost_root
from gains.structure import square_matrices

# both methods give 12 digits for well-scaled loops; a missed crossing is off by far more
_AGREEMENT = 1e-8
# the rightmost root moves by omega |dtau| or so: at a part in 10^4 off the margin its sign is beyond its own error
_BESIDE = 1e-4
# where the loop is checked for stability below the margin, as fractions of it
_FRACTIONS = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 1.0 - _BESIDE)
# delays checked when there is no margin, in units of 1 / ||A0 + A1||-like time constants
_SPANS = (0.0, 0.3, 1.0, 3.0, 10.0)


def checked_delay_margin(A0: ArrayLike, A1: ArrayLike) -> float:
    """`delay_margin`, confirmed by the frequency sweep and by the spectrum at delays below and above it.

    Slower by a factor of a hundred; for a design that is to be flown, not for the inside of an optimisation.

    Parameters
    ----------
    A0, A1
        Real matrices (n, n), 1/s.

    Raises
    ------
    BadModelError
        The matrices are not square, finite and of one size.
    DisagreementError
        The methods differ; the message lists what each one says.

    Examples
    --------
    x'(t) = -x(t - tau) is stable up to tau = pi / 2:

    >>> from gains.delay_opinions import checked_delay_margin
    >>> round(checked_delay_margin([[0]], [[-1]]), 6)
    1.570796
    """
    now, late = square_matrices(A0=A0, A1=A1)
    margin_s = delay_margin(A0, A1)
    sweep_s = frequency_sweep_margin(A0, A1)
    if margin_s != sweep_s and not abs(margin_s - sweep_s) <= _AGREEMENT * margin_s:
        raise DisagreementError(f"the algebraic delay margin is {margin_s} s, the frequency sweep says {sweep_s} s")
    if margin_s == 0.0:
        should_be_stable, should_be_unstable = (), (0.0,)
    elif isfinite(margin_s):
        should_be_stable = tuple(fraction * margin_s for fraction in _FRACTIONS)
        should_be_unstable = ((1.0 + _BESIDE) * margin_s,)
    else:
        time_constant_s = 1.0 / float(np.linalg.norm(now) + np.linalg.norm(late))
        should_be_stable, should_be_unstable = tuple(span * time_constant_s for span in _SPANS), ()
    for delay_s in should_be_stable:
        _confirm(A0, A1, margin_s, delay_s, stable=True)
    for delay_s in should_be_unstable:
        _confirm(A0, A1, margin_s, delay_s, stable=False)
    return margin_s


def _confirm(A0: ArrayLike, A1: ArrayLike, margin_s: float, delay_s: float, *, stable: bool) -> None:
    root = rightmost_root([(A0, 0.0), (A1, delay_s)])
    if (root.real < 0.0) != stable:
        wanted = "stable" if stable else "unstable"
        raise DisagreementError(
            f"the delay margin is {margin_s} s, so the loop should be {wanted} at {delay_s} s, "
            f"but its rightmost root there is {root}"
        )
