"""Vector length for kernels, bit-identical to CPython's `math.hypot`; the C library's differs in the last bit."""

import math

from scenarios.kernel import kernel

_SPLIT = 134217729.0
"""2^27 + 1: splits a double into two halves whose products are exact."""


@kernel
def hypot(x: float, y: float) -> float:
    """The square root of x² + y², as CPython 3.11 computes it (`vector_norm` in mathmodule.c).

    The squares are added to 1.0 as exact sums of their halves, and the root is corrected by the residual of its square.
    """
    x, y = abs(x), abs(y)
    most = max(x, y)
    if math.isinf(x) or math.isinf(y):
        return math.inf
    if math.isnan(x) or math.isnan(y):
        return math.nan
    if most == 0.0:
        return most
    _, exponent = math.frexp(most)
    if exponent < -1023:  # subnormal
        sum_, rest = _add(1.0, 0.0, (x / most) * (x / most))
        sum_, rest = _add(sum_, rest, (y / most) * (y / most))
        return most * math.sqrt(sum_ - 1.0 + rest)
    scale = math.ldexp(1.0, -exponent)
    high, low = _halves(x * scale)
    sum_, rest1 = _add(1.0, 0.0, high * high)
    sum_, rest2 = _add(sum_, 0.0, 2.0 * high * low)
    rest3 = low * low
    high, low = _halves(y * scale)
    sum_, rest1 = _add(sum_, rest1, high * high)
    sum_, rest2 = _add(sum_, rest2, 2.0 * high * low)
    rest3 += low * low
    root = math.sqrt(sum_ - 1.0 + (rest1 + rest2 + rest3))
    high, low = _halves(root)
    sum_, rest1 = _add(sum_, rest1, -high * high)
    sum_, rest2 = _add(sum_, rest2, -2.0 * high * low)
    sum_, rest3 = _add(sum_, rest3, -low * low)
    root += (sum_ - 1.0 + (rest1 + rest2 + rest3)) / (2.0 * root)
    return root / scale


@kernel
def _halves(x: float) -> tuple[float, float]:
    far = x * _SPLIT
    high = far - (far - x)
    return high, x - high


@kernel
def _add(sum_: float, rest: float, x: float) -> tuple[float, float]:
    """Compensated addition: a sum with one more term, and the rounding errors so far."""
    total = sum_ + x
    return total, rest + ((sum_ - total) + x)
