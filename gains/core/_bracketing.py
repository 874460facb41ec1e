"""Roots and peaks of scalar functions within brackets.

Most functions here evaluate all abscissae (k,) at once: eigenvalue problems take nearly all the time, and each step
then solves them in one batch.
"""

from collections.abc import Callable

import numpy as np

from gains.core.arrays import BoolArray, FloatArray

Functions = Callable[[FloatArray], FloatArray]

_EPS = float(np.finfo(np.float64).eps)
_GOLDEN = (3.0 - 5.0**0.5) / 2.0
# 60 steps shrink a bracket to 1e-13: enough for a kink; the abscissa of a smooth peak is known to only 1e-8 anyway
_GOLDEN_STEPS = 60
# refinements of a peak: at most this many, each sampled at these fractions of its bracket
_LOOKS, _SHARES = 14, np.linspace(0.0, 1.0, 17)
# a peak exceeds its highest sample by less than this many times the difference of neighbouring samples
_REACH = 4.0
# limit on steps of false position, reached when the function is too rough for the resolution
_FALSE_POSITIONS = 30


def peaks(function: Functions, a: FloatArray, b: FloatArray) -> FloatArray:
    """Abscissae of the maxima of functions that each have one maximum in [a, b], by golden section."""
    c: FloatArray = a + _GOLDEN * (b - a)
    d: FloatArray = b - _GOLDEN * (b - a)
    at_c, at_d = function(c), function(d)
    for _ in range(_GOLDEN_STEPS):
        to_left = at_c > at_d
        a, b = np.where(to_left, a, c), np.where(to_left, d, b)
        new = np.where(to_left, a + _GOLDEN * (b - a), b - _GOLDEN * (b - a))
        at_new = function(new)
        c, d = np.where(to_left, new, d), np.where(to_left, c, new)
        at_c, at_d = np.where(to_left, at_new, at_d), np.where(to_left, at_c, at_new)
    return (a + b) / 2.0


def highest(function: Functions, grid: FloatArray, values: FloatArray | None = None) -> tuple[float, float]:
    """Abscissa and value of the maximum over a rising grid; local maxima that may exceed the largest are refined.

    `values` on the grid are computed if they are None.
    """
    values = function(grid) if values is None else values
    best = int(np.argmax(values))
    place, height = float(grid[best]), float(values[best])
    inner = np.flatnonzero(may_reach_zero(grid, (values - height)[:, np.newaxis])) + 1
    low, high, row = grid[inner - 1], grid[inner + 1], np.arange(inner.size)
    for _ in range(_LOOKS if inner.size else 0):
        points = low[:, np.newaxis] + (high - low)[:, np.newaxis] * _SHARES
        values = function(points.ravel()).reshape(points.shape)
        at = np.clip(values.argmax(axis=1), 1, _SHARES.size - 2)
        low, high, top = points[row, at - 1], points[row, at + 1], values[row, at]
        if top.max() > height:
            best = int(top.argmax())
            place, height = float(points[best, at[best]]), float(top[best])
        if (2.0 * top - values[row, at - 1] - values[row, at + 1]).max() <= _EPS * abs(height):
            break
    return place, height


def may_reach_zero(points: FloatArray, values: FloatArray) -> BoolArray:
    """Mask (k - 2, r) of the local maxima below zero, in samples (k, r) of r functions, that may hide a zero.

    A smooth peak exceeds its highest sample by an eighth of its height above the neighbours; a kink by as much as the
    line through one neighbour rises over the other step. A neighbour at the same abscissa is ignored.
    """
    inner, left, right = values[1:-1], values[:-2], values[2:]
    before, after = np.diff(points)[:-1, np.newaxis], np.diff(points)[1:, np.newaxis]
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = np.fmax(
            (inner - left) * np.maximum(1.0, after / before), (inner - right) * np.maximum(1.0, before / after)
        )
    return (inner >= left) & (inner >= right) & (inner <= 0.0) & (inner + _REACH * rise >= 0.0)


def bracketed_roots(function: Functions, a: FloatArray, b: FloatArray, fa: FloatArray, fb: FloatArray) -> FloatArray:
    """Roots of many scalar functions at once, each within its bracket [a, b], to rounding.

    Chandrupatla's method: inverse quadratic interpolation where it is safe, bisection elsewhere. `function` takes all
    abscissae (k,) and returns all values (k,); `fa` and `fb` differ in sign.
    """
    fraction: FloatArray | float = 0.5
    # 100 halvings exhaust any bracket of doubles; interpolation needs about 6
    for _ in range(100):
        x = a + fraction * (b - a)
        fx = function(x)
        if not fx.any():
            return x
        same = np.sign(fx) == np.sign(fa)
        c, fc = np.where(same, a, b), np.where(same, fa, fb)
        b, fb = np.where(same, b, a), np.where(same, fb, fa)
        a, fa = x, fx
        best = np.where(np.abs(fa) < np.abs(fb), a, b)
        width = np.abs(b - a)
        tolerance = 2.0 * _EPS * np.abs(best)
        if bool(np.all((width <= 2.0 * tolerance) | (fa == 0.0))):
            break
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            xi: FloatArray = (a - b) / (c - b)
            phi: FloatArray = (fa - fb) / (fc - fb)
            safe = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
            quadratic = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
        fraction = np.where(safe & np.isfinite(quadratic), quadratic, 0.5)
        least = np.minimum(tolerance / np.maximum(width, tolerance), 0.5)
        fraction = np.clip(fraction, least, 1.0 - least)
        fraction = np.where(fa == 0.0, 0.0, fraction)
    return np.where(np.abs(fa) <= np.abs(fb), a, b)


def met_end(
    excess: Callable[[float], float], met: tuple[float, float], missed: tuple[float, float], *, resolution: float
) -> float:
    """An abscissa at which an expensive, slightly rough function is between 0 and `resolution`, by false position.

    `met` and `missed` are abscissae with their excess, >= 0 and < 0. When one end moves twice in a row, the value at
    the other is halved, so that both close in (the Illinois rule); this takes about six steps.
    """
    (x, value), (outside, f_outside) = met, missed
    f_inside, moved = value, 0
    for _ in range(_FALSE_POSITIONS):
        if value <= resolution or f_outside >= 0.0:
            break
        middle = x + (outside - x) * min(max(f_inside / (f_inside - f_outside), 0.01), 0.99)
        f_middle = excess(middle)
        if f_middle >= 0.0:
            x, value, f_inside = middle, f_middle, f_middle
            f_outside = f_outside / 2.0 if moved > 0 else f_outside
            moved = 1
        else:
            outside, f_outside = middle, f_middle
            f_inside = f_inside / 2.0 if moved < 0 else f_inside
            moved = -1
    return x
