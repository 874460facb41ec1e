"""Gains of the inclusion principle that meet a requirement, or which part of it to relax and how far.

Every combination is one search of `gains.search`: what is given limits it, what is open is made as large as possible.
"""

from dataclasses import replace
from math import floor, log10

from gains.errors import InfeasibleError
from gains.requirement import DELAY_MARGIN_MAX_S, PeakLimit, Requirement
from gains.scalar_gains import ScalarGains
from gains.search import fastest_decay, largest_alpha, largest_margin

# The search aims this much above a margin asked for, so that rounding cannot leave it below.
_MARGIN_AIM_S = 2e-10
# A margin is found to this share of itself, a decay rate for a message to a coarser one.
_MARGIN_RESOLUTION, _DECAY_STEPS = 1e-9, 14


def required_gains(wanted: Requirement, period_s: float) -> ScalarGains:
    """Return the gains that meet the requirement and are the best in what it leaves open.

    With a delay margin they have the largest α of all that meet the rest, without one the largest margin, and of those
    the largest α.

    Parameters
    ----------
    wanted
        What to reach.
    period_s
        Period of the control loop: sample, hold.

    Raises
    ------
    InfeasibleError
        If no gains meet the requirement; the message says which part of it to relax, and how far.

    Examples
    --------
    Two equal poles at −1 have the largest margin of all gains that decay like e^{−t}:

    >>> from gains.required import required_gains
    >>> from gains.requirement import Requirement
    >>> gains = required_gains(Requirement(decay_rate_1_s=1.0), 0.02)
    >>> round(gains.k1, 3), round(gains.k3, 3)
    (2.0, 1.0)
    """
    gains = _best_gains(wanted, period_s)
    if gains is None:
        raise InfeasibleError(_conflict(wanted, period_s))
    return gains


def _best_gains(wanted: Requirement, period_s: float) -> ScalarGains | None:
    """The gains of `required_gains`, None if there are none."""
    limit, decay = wanted.peak_limit, wanted.decay_rate_1_s or 0.0
    margin_s = wanted.delay_margin_s
    if margin_s is None and wanted.alpha is not None:
        found = largest_margin(wanted.alpha, period_s, limit, decay)
        return None if found is None else found[1]
    if margin_s is None:
        margin_s = _margin_of_decay(decay, period_s, limit)
    else:
        margin_s += _MARGIN_AIM_S
    gains = largest_alpha(margin_s, period_s, limit, decay)
    return None if gains is None or gains.alpha < (wanted.alpha or 0.0) else gains


def _margin_of_decay(decay_rate_1_s: float, period_s: float, limit: PeakLimit) -> float:
    """The largest margin (s) of which gains decay as fast as this, 0 if none do: the fastest decay falls with it."""
    low, high = 0.0, DELAY_MARGIN_MAX_S
    if fastest_decay(high, period_s, limit) >= decay_rate_1_s:
        return high
    if fastest_decay(low, period_s, limit) < decay_rate_1_s:
        return 0.0
    while high - low > _MARGIN_RESOLUTION * high:
        middle = (low + high) / 2
        low, high = (middle, high) if fastest_decay(middle, period_s, limit) >= decay_rate_1_s else (low, middle)
    return low


def _conflict(wanted: Requirement, period_s: float) -> str:
    """What cannot be had, and how far each part alone would have to be relaxed."""
    given = {
        name: value
        for name in ("delay_margin_s", "alpha", "decay_rate_1_s")
        if (value := getattr(wanted, name)) is not None
    }
    reached = {name: _rounded_down(most) for name in given if (most := _most(name, wanted, period_s)) > 0.0}
    lower = [f"lower {name} to {most:g}" for name, most in reached.items()]
    unlimited = replace(wanted, string_peak_max=None)
    if wanted.string_peak_max is not None and _best_gains(unlimited, period_s) is not None:
        lower.append(f"raise string_peak_max = {wanted.string_peak_max:g}")
    named = " and ".join(f"{name} = {value:g}" for name, value in given.items())
    conflict = "exclude each other" if len(given) > 1 else "cannot be reached"
    advice = " or ".join(lower) if lower else "lower more than one of them" if len(given) > 1 else "lower period_s"
    return f"{named} {conflict} with period_s = {period_s:g}: {advice}"


def _most(name: str, wanted: Requirement, period_s: float) -> float:
    """The largest value of one part of the requirement that leaves the others as they are; 0 if none does."""
    limit, margin_s = wanted.peak_limit, wanted.delay_margin_s or 0.0
    alpha, decay = wanted.alpha or 0.0, wanted.decay_rate_1_s or 0.0
    if name == "alpha":
        gains = largest_alpha(margin_s, period_s, limit, decay)
        return gains.alpha if gains else 0.0
    if name == "delay_margin_s":
        found = largest_margin(alpha, period_s, limit, decay) if alpha > 0.0 else None
        return _margin_of_decay(decay, period_s, limit) if alpha == 0.0 else found[0] if found else 0.0
    low, high = 0.0, fastest_decay(margin_s, period_s, limit)
    if alpha == 0.0:
        return high
    for _ in range(_DECAY_STEPS):
        middle = (low + high) / 2
        gains = largest_alpha(margin_s, period_s, limit, middle)
        low, high = (middle, high) if gains is not None and gains.alpha >= alpha else (low, middle)
    return low


def _rounded_down(value: float) -> float:
    """Four digits, and no more than the value."""
    unit = 10.0 ** (floor(log10(value)) - 3)
    return floor(value / unit) * unit
