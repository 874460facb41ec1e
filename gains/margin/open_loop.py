"""Loops given as an input-output system: from python-control, from `scipy.signal`, or from a model file.

The loop is closed by u(t) = -y(t - tau), the negative unit feedback that margins of open loops refer to. Any other gain
or sign must be part of the system: -K (s I - A)^{-1} B for u = +K x. Neither package is imported; a system is
recognised by its attributes.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import real_matrix, square_matrices


def delayed_feedback(system: Any) -> tuple[FloatArray, FloatArray]:
    """(A0, A1) of x'(t) = A0 x(t) + A1 x(t - tau), the loop of y = L(s) u closed by u(t) = -y(t - tau).

    `system` has the attributes A, B, C and D, like a `StateSpace`, or `num` and `den` with the highest power first,
    like a `TransferFunction` with one input and one output. A0 = A, A1 = -B C, both (n, n) in 1/s.

    Raises BadModelError if the system has neither set of attributes, is discrete in time, has a direct path from input
    to output (its loop then has infinitely many roots near a vertical line), or has more outputs than inputs or fewer.

    1 / (s (s + 1)) has a phase margin of 51.8° at 0.786 rad/s, a delay of 1.15 s at that frequency:

    >>> from scipy.signal import TransferFunction
    >>> from gains import delay_margin, delayed_feedback
    >>> round(delay_margin(*delayed_feedback(TransferFunction([1], [1, 1, 0]))), 3)
    1.151
    """
    if getattr(system, "dt", None):
        wanted = "0 or None is wanted; sampled_delay_margin takes A, B and K of a plant under a hold"
        raise BadModelError(f"the system has dt = {system.dt}; {wanted}")
    if all(hasattr(system, name) for name in "ABCD"):
        return feedback_of_matrices(system.A, system.B, system.C, system.D)
    if hasattr(system, "num") and hasattr(system, "den"):
        return feedback_of_polynomials(system.num, system.den)
    raise BadModelError(
        f"read an object of type {type(system).__name__}; a system with A, B, C, D or with num, den is wanted"
    )


def feedback_of_matrices(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike | None = None
) -> tuple[FloatArray, FloatArray]:
    """`delayed_feedback` of a state-space system: A (n, n), B (n, p), C (p, n), D (p, p) zero; raises likewise.

    >>> feedback_of_matrices([[0, 1], [0, -1]], [[0], [1]], [[1, 0]])[1].tolist()
    [[0.0, 0.0], [-1.0, 0.0]]
    """
    [now] = square_matrices(A=A)
    inputs, outputs = real_matrix("B", B), real_matrix("C", C)
    if len(inputs) != len(now) or outputs.shape != inputs.shape[::-1]:
        wanted = f"{len(now)} rows and {len(now)} columns, and as many outputs as inputs, are wanted"
        raise BadModelError(f"B has shape {inputs.shape} and C {outputs.shape}; {wanted}")
    if D is not None and real_matrix("D", D).any():
        raise BadModelError("D is not zero; a system without a direct path from input to output is wanted")
    return now, 0.0 - inputs @ outputs


def feedback_of_polynomials(num: Any, den: Any) -> tuple[FloatArray, FloatArray]:
    """`delayed_feedback` of the transfer function num / den, highest powers first; either may be nested, as in [[num]].

    Raises BadModelError as `delayed_feedback` does.

    >>> sum(feedback_of_polynomials([2], [1, 3])).tolist()
    [[-5.0]]
    """
    above, below = _polynomial("num", num), _polynomial("den", den)
    if above.size >= below.size:
        raise BadModelError(
            f"num has degree {above.size - 1} and den {below.size - 1}; more poles than zeros are wanted"
        )
    # controllable canonical form; scipy.signal.tf2ss takes coefficients of num below 1e-14 of den[0] for zeros
    n = below.size - 1
    A, B, C = np.eye(n, k=-1), np.zeros((n, 1)), np.zeros((1, n))
    A[:1], B[:1], C[0, n - above.size :] = -below[1:] / below[0], 1.0, above / below[0]
    return feedback_of_matrices(A, B, C)


def _polynomial(name: str, value: Any) -> FloatArray:
    """The coefficients without leading zeros; at least one."""
    try:
        nested = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        nested = np.zeros((2, 0))
    if any(length != 1 for length in nested.shape[:-1]):
        raise BadModelError(f"{name} is not one polynomial; for several inputs or outputs, A, B, C and D are wanted")
    known = np.trim_zeros(real_matrix(name, nested.reshape(1, -1))[0], "f")
    if not known.size and name == "den":
        raise BadModelError("den is zero; a polynomial is wanted")
    return known if known.size else np.zeros(1)
