"""How fast the errors of a flight grow or decay, with the uncertainty of that rate, and where the rate passes zero.

"Did it diverge within 60 s" is a poor test of a delay margin: near the margin errors change so slowly that chance
decides. Here the modes z_k of the flown loop are fitted to the tick record, y[n] = sum_k a_k z_k^n in every channel.
The growth rate is ln|z| / T of the slowest mode, and the delay margin is where it is zero.

Method: ESPRIT (Roy and Kailath, "ESPRIT - estimation of signal parameters via rotational invariance techniques",
IEEE Trans. ASSP 37(7), 1989) on the Hankel matrices of all channels side by side, because the channels share their
modes. It runs twice, the second time on y[n] e^{-g n T} with g from the first: start and end of a motion that changes
by orders of magnitude then have equal weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gcs.control.tick import TickArray, chosen

DECAY_KEPT = 0.02
"""A motion is fitted until it has decayed to this share of its largest value. Rounding of the telemetry, which the loop
feeds back and amplifies, is well below that, in real time too."""
FEWEST_SAMPLES = 12
_MOST_SAMPLES = 300
"""Longer motions are decimated: accuracy depends on the length of the window, cost on the number of samples."""
_ENVELOPE_S = 1.0
_FEWEST_ENVELOPE = 4
_PARTS = 8
"""Number of parts of a window. The scatter of their slopes gives the standard error of the mean growth rate."""
_FEWEST_SIGNS = 3
"""Fewest sign changes that give a frequency: one full cycle."""
_LONGEST_HANKEL = 120
FOLLOWER_MODES = 4
"""Two states and two delayed states: enough for a vehicle that does not react to those behind it."""
_RANK_FLOOR = 1e-9
_LEAST_SHARE, _MISFITS = (0.03, 0.1), 10.0
"""A mode counts if its share of the motion exceeds this many misfits, a threshold that is clipped to these two shares.
Modes from rounding and clock noise have a smaller share."""
CHANNELS = (
    "spacing_error_north_m",
    "spacing_error_east_m",
    "velocity_error_north_m_s",
    "velocity_error_east_m_s",
)


@dataclass(frozen=True)
class Motion:
    """Errors at equally spaced times, counted on the vehicle's clock from the first sample used."""

    time_s: FloatArray
    """(n,)"""
    values: FloatArray
    """(n, channels) spacing errors in m and velocity errors in m/s."""
    period_s: float


@dataclass(frozen=True)
class Growth:
    """Growth rate of the slowest mode found, ln|z| / T: above zero the loop is unstable.

    `error_1_s` is the standard error. For a fitted mode it is the larger of the error from the misfit and half the
    difference between the rates of the window's two halves. The window is `start_s` to `end_s` of the motion's
    time. The frequency is None if the growth is that of an envelope, or if there are too few sign changes.
    """

    growth_1_s: float
    error_1_s: float
    frequency_rad_s: float | None
    start_s: float
    end_s: float
    samples: int


def motion_of(ticks: TickArray, system_ids: Sequence[int], *, period_s: float) -> Motion:
    """The errors of some vehicles at the sampling times of the states used to command them.

    A state used by two ticks (telemetry late or slower than control) counts once. `sample_boot_ms` is exact, so the
    samples of regular telemetry are equally spaced to the last digit. Otherwise a cubic spline interpolates them to
    equally spaced times.
    """
    columns: list[FloatArray] = []
    for system_id in system_ids:
        rows = chosen(ticks, (ticks["system_id"] == system_id) & ticks["commanded"] & (ticks["time_s"] >= 0.0))
        boot_ms, first = np.unique(rows["sample_boot_ms"], return_index=True)
        rows, time_s = rows[first], (boot_ms - boot_ms[:1]) * 1e-3
        values = np.stack([rows[name] for name in CHANNELS], axis=1).astype(np.float64)
        values = values[:, np.isfinite(values).all(axis=0)]  # the leader has no spacing error
        if len(time_s) >= 4 and not np.allclose(np.diff(time_s), period_s, rtol=0.0, atol=1e-6):
            from scipy.interpolate import CubicSpline  # slow to import, and rarely needed

            values = CubicSpline(time_s, values)(np.arange(0.0, time_s[-1], period_s))
        columns.append(values)
    count = min((len(column) for column in columns), default=0)
    values = np.hstack([column[:count] for column in columns]) if columns else np.empty((0, 0))
    return Motion(np.arange(count, dtype=np.float64) * period_s, values, period_s)


def fit_growth(motion: Motion, *, start_s: float, end_s: float = np.inf, modes: int = FOLLOWER_MODES) -> Growth | None:
    """The growth rate of a motion by a fit of its modes from `start_s` on, when the faster ones have decayed.

    The window ends at `end_s`, or when the motion has decayed to `DECAY_KEPT`. At most `modes` modes are fitted: a loop
    of several vehicles needs more. None if fewer than `FEWEST_SAMPLES` samples are left or nothing moves.
    """
    time_s, values = _window(motion, start_s, end_s)
    if len(values) < FEWEST_SAMPLES:
        return None
    step = max(1, len(values) // _MOST_SAMPLES)
    kept = values[::step]
    scale = np.sqrt((kept**2).mean(axis=0))
    kept = kept[:, scale > 0.0] / scale[scale > 0.0]
    period_s = motion.period_s * step
    fitted = _slowest_mode(kept, period_s, modes)
    if fitted is None:
        return None
    mode, misfit_error = fitted
    halves = [_slowest_mode(part, period_s, modes) for part in np.array_split(kept, 2)] if len(kept) >= 24 else []
    rates = [half[0].real for half in halves if half is not None]
    drift = abs(rates[0] - rates[1]) / 2.0 if len(rates) == 2 else abs(mode.real) / 10.0
    return Growth(
        growth_1_s=mode.real,
        error_1_s=max(misfit_error, drift),
        frequency_rad_s=abs(mode.imag),
        start_s=float(time_s[0]),
        end_s=float(time_s[-1]),
        samples=len(values),
    )


def norm_growth(motion: Motion, *, start_s: float, end_s: float = np.inf) -> Growth | None:
    """The growth rate of a motion under varying delays: the slope of the logarithm of its norm over all channels.

    Such a motion has a mean rate but no modes; a fit would find spurious ones. The window is that of `fit_growth`. The
    frequency is computed from the sign changes.
    """
    time_s, values = _window(motion, start_s, end_s)
    scale = np.sqrt((values**2).mean(axis=0)) if len(values) else np.zeros(0)
    values = values[:, scale > 0.0] / scale[scale > 0.0]
    size = np.linalg.norm(values, axis=1)
    moving = size > 0.0
    if np.count_nonzero(moving) < FEWEST_SAMPLES:
        return None
    return replace(_slope(time_s[moving], np.log(size[moving])), frequency_rad_s=_frequency(time_s, values))


def envelope_growth(size: FloatArray, *, period_s: float, start_s: float) -> Growth | None:
    """The growth rate of a whole formation's errors, sampled every `period_s`: the slope of the log of their envelope.

    It is for flights without a free response to fit, because random links push the vehicles all the time or many
    vehicles have large errors at once. The envelope is the largest error within a second. It is fitted until it has
    decayed to `DECAY_KEPT`, below which noise may sustain it.
    """
    reach = max(1, round(_ENVELOPE_S / period_s))
    if size.size < reach + 1:
        return None
    envelope = np.lib.stride_tricks.sliding_window_view(size, reach).max(axis=1)
    time_s = period_s * np.arange(envelope.size)
    inside = (time_s >= start_s) & (envelope > 0.0) & (np.arange(envelope.size) < _count_before_rest(envelope[:, None]))
    time_s, level = time_s[inside], np.log(envelope[inside])
    if time_s.size < _FEWEST_ENVELOPE:
        return None
    return _slope(time_s, level)


def _slope(time_s: FloatArray, level: FloatArray) -> Growth:
    """The slope of a logarithm over time; its standard error is that of the mean slope of `_PARTS` parts.

    Random delays make the logarithm a random walk with drift, whose parts have independent slopes.
    """
    parts = min(_PARTS, time_s.size // 2)
    split = zip(np.array_split(time_s, parts), np.array_split(level, parts), strict=True)
    slopes = [np.polyfit(t, y, 1)[0] for t, y in split]
    return Growth(
        growth_1_s=float(np.polyfit(time_s, level, 1)[0]),
        error_1_s=float(np.std(slopes, ddof=1)) / parts**0.5,
        frequency_rad_s=None,
        start_s=float(time_s[0]),
        end_s=float(time_s[-1]),
        samples=time_s.size,
    )


def _frequency(time_s: FloatArray, values: FloatArray) -> float | None:
    """The median of the channels' mean frequencies, from their sign changes; None if no channel has enough of them."""
    found: list[float] = []
    for channel in values.T:
        before = np.flatnonzero(channel[:-1] * channel[1:] < 0.0)
        share = channel[before] / (channel[before] - channel[before + 1])
        crossed_s = time_s[before] + share * (time_s[before + 1] - time_s[before])
        if crossed_s.size >= _FEWEST_SIGNS:
            found.append(np.pi * (crossed_s.size - 1) / float(np.ptp(crossed_s)))
    return float(np.median(found)) if found else None


def _window(motion: Motion, start_s: float, end_s: float) -> tuple[FloatArray, FloatArray]:
    """Times and values from the start to the end, or until the motion has decayed."""
    inside = (motion.time_s >= start_s) & (motion.time_s < end_s)
    values = motion.values[inside]
    values = values[: _count_before_rest(values)]
    return motion.time_s[inside][: len(values)], values


def _count_before_rest(values: FloatArray) -> int:
    """Number of samples until the motion, averaged over the channels, stays below `DECAY_KEPT` of its maximum."""
    if not values.size:
        return 0
    size = (np.abs(values) / np.maximum(np.abs(values).max(axis=0), np.finfo(float).tiny)).mean(axis=1)
    still_to_come = np.maximum.accumulate(size[::-1])[::-1]
    return int(np.count_nonzero(still_to_come >= DECAY_KEPT * size.max()))


def _slowest_mode(values: FloatArray, period_s: float, modes: int) -> tuple[complex, float] | None:
    """s = ln z / T of the slowest mode that counts (`_LEAST_SHARE`), and the standard error of its real part."""
    if len(values) < FEWEST_SAMPLES or not values.any():
        return None
    time_s = np.arange(len(values)) * period_s
    first = _modes(values, modes)
    if first is None:
        return None
    slowest = _slowest(first, values)
    trend_1_s = float(np.log(abs(slowest)) / period_s)
    # relative to the middle of the window, to keep the weights from overflowing
    flattened = values * np.exp(np.clip(-trend_1_s * (time_s - time_s.mean()), -300.0, 300.0))[:, np.newaxis]
    z = _modes(flattened, modes)
    if z is None:
        return None
    # Flattened, the mode has constant amplitude. If another mode now outweighs it, the first fit is the better one.
    flat = _slowest(z, flattened)
    same = z[np.abs(z - slowest / abs(slowest)).argmin()]
    if not np.isclose(abs(flat), abs(same), rtol=1e-9, atol=0.0):
        return complex(np.log(slowest)) / period_s, _rate_error(first, slowest, values, period_s)
    return complex(trend_1_s, 0.0) + complex(np.log(flat)) / period_s, _rate_error(z, flat, flattened, period_s)


def _modes(values: FloatArray, most: int) -> ComplexArray | None:
    """The modes z shared by all channels, by ESPRIT of at most order `most`."""
    count = len(values)
    rows = min(count // 2, _LONGEST_HANKEL)
    windows = np.lib.stride_tricks.sliding_window_view(values, count - rows + 1, axis=0)  # (rows, channels, columns)
    # the left singular vectors of H = L Q are those of L, which is small
    L_transposed: Any = np.linalg.qr(windows.reshape(rows, -1).T, mode="r")
    left, singular, _ = np.linalg.svd(L_transposed.T)
    order = min(most, int(np.count_nonzero(singular > _RANK_FLOOR * singular[0])), rows - 1)
    if order == 0:
        return None
    shift = np.linalg.lstsq(left[:-1, :order], left[1:, :order], rcond=None)[0]
    z = np.linalg.eigvals(shift).astype(np.complex128)
    z = z[np.abs(z) > 1e-6]
    return z if z.size else None


def _amplitudes(z: ComplexArray, values: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Motions z^n (n, modes), scaled to at most one, and their amplitudes (modes, channels) by least squares."""
    n = np.arange(len(values))[:, np.newaxis]
    exponent = n * np.log(z)
    powers = np.exp(exponent - exponent.real.max(axis=0)).astype(np.complex128)
    return powers, np.linalg.lstsq(powers, values, rcond=None)[0].astype(np.complex128)


def _slowest(z: ComplexArray, values: FloatArray) -> complex:
    """The mode of largest modulus among those that count (`_LEAST_SHARE`)."""
    powers, amplitudes = _amplitudes(z, values)
    size = np.linalg.norm(values)
    carried = np.linalg.norm(powers, axis=0) * np.linalg.norm(amplitudes, axis=1) / size
    misfit = float(np.linalg.norm(values - (powers @ amplitudes).real) / size)
    counting = z[carried >= min(np.clip(_MISFITS * misfit, *_LEAST_SHARE), float(carried.max()))]
    return complex(counting[np.abs(counting).argmax()])


def _rate_error(z: ComplexArray, mode: complex, values: FloatArray, period_s: float) -> float:
    """The standard error (1/s) of the rate of one of the modes, from the misfit.

    A change of the rate adds a motion t e^{st}. Only the part that no change of amplitude explains determines the rate.
    """
    powers, amplitudes = _amplitudes(z, values)
    misfit = values - (powers @ amplitudes).real
    k = int(np.argmin(np.abs(z - mode)))
    n = np.arange(len(values))
    own = np.outer(powers[:, k], amplitudes[k]).real * (1 if abs(mode.imag) < 1e-9 else 2)
    slope = own * (n - n.mean())[:, np.newaxis] * period_s
    return float(np.sqrt((misfit**2).mean()) / max(np.linalg.norm(slope), np.finfo(float).tiny))


@dataclass(frozen=True)
class GrowthPoint:
    """One flight near the onset: the value of the varied quantity, and the measured growth rate.

    `varied` is the loop delay (s), or the size of a disturbance (1/s).
    """

    varied: float
    growth_1_s: float
    error_1_s: float


@dataclass(frozen=True)
class Zero:
    """Where growth rises through zero: `varied` as in `GrowthPoint`, its standard error, and the slope of growth there.

    `inside` says that there are flights on both sides; otherwise the zero is extrapolated. `misfit` is the distance of
    the flights from the curve in standard errors: well above one where no parabola fits, for example across a kink.
    The growth of a sampled loop has a kink where the delay is a whole number of periods.
    """

    varied: float
    error: float
    slope: float
    inside: bool
    misfit: float


def locate_zero(points: Sequence[GrowthPoint]) -> Zero | None:
    """Where growth rises through zero, from at least two flights at different values of the varied quantity.

    Fits a line, or a parabola to four or more flights, by least squares weighted by the flights' errors. Of several
    rising zeros, returns the one nearest the flight with the smallest growth rate in magnitude. None if there is none.
    """
    if len({round(point.varied, 6) for point in points}) < 2:
        return None
    varied, growth, error = np.array([(p.varied, p.growth_1_s, p.error_1_s) for p in points], dtype=float).T
    # errors count as at least a thousandth of the spread of the rates: the curve is not exactly a parabola
    error = np.maximum(error, 1e-3 * float(np.ptp(growth)) + 1e-9)
    middle, half = float(varied.mean()), float(np.ptp(varied)) / 2.0
    x = (varied - middle) / half
    for degree in (2, 1) if len(points) >= 4 else (1,):
        weighted = np.vander(x, degree + 1) / error[:, np.newaxis]
        coefficients = np.linalg.lstsq(weighted, growth / error, rcond=None)[0]
        roots, slopes = np.roots(coefficients), np.polyder(coefficients)
        real = roots[np.abs(roots.imag) < 1e-9].real
        rising = real[np.polyval(slopes, real) > 0.0]
        if rising.size:
            at = float(rising[np.abs(rising - x[np.abs(growth).argmin()]).argmin()])
            row = at ** np.arange(degree, -1, -1.0)
            slope = float(np.polyval(slopes, at))
            variance = float(row @ np.linalg.pinv(weighted.T @ weighted) @ row)
            off, free = weighted @ coefficients - growth / error, len(points) - degree - 1
            misfit = float(np.linalg.norm(off)) / free**0.5 if free else 0.0
            return Zero(
                varied=middle + half * at,
                error=half * variance**0.5 / slope * max(1.0, misfit),
                slope=slope / half,
                inside=bool((growth < 0.0).any() and (growth > 0.0).any()),
                misfit=misfit,
            )
    return None
