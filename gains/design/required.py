"""Gains of the inclusion principle that meet a requirement, or advice on which part to relax and how far.

Any combination of required figures is one search of `gains.design.search`: they are its constraints, and the others are
maximised.
"""

from dataclasses import replace

from gains.core._bracketing import met_end
from gains.core.errors import InfeasibleError
from gains.core.requirement import DELAY_MARGIN_MAX_S, ChainLimit, Requirement
from gains.criteria.parts import parts_of, rounded
from gains.design.search import fastest_decay, largest_alpha, largest_margin
from gains.performance.lone_margin import lone_margin
from gains.performance.response import Response, sampled_margin
from gains.performance.scalar_gains import PAIR, ScalarGains
from gains.sampled.multirate import Timing

# The search aims this much above the required margin to keep rounding from falling below it.
_MARGIN_AIM_S = 2e-10
# Relative accuracy of a margin; bisections for a decay rate in a message.
_MARGIN_RESOLUTION, _DECAY_STEPS = 1e-9, 14


def required_gains(wanted: Requirement, period_s: float) -> ScalarGains:
    """Return the gains that meet the requirement and are otherwise best.

    With a required delay margin, they have the largest α of all gains that meet the rest; without one, the largest
    margin, and the largest α at that margin. `period_s` is the period of sampling and holding. InfeasibleError if no
    gains meet the requirement, saying what to relax and how far.
    """
    gains = _best_gains(wanted, period_s)
    if gains is None:
        raise InfeasibleError(_conflict(wanted, period_s))
    return gains


def _best_gains(wanted: Requirement, period_s: float) -> ScalarGains | None:
    """The gains of `required_gains`, None if there are none."""
    limit, decay = wanted.chain_limit, wanted.decay_rate_1_s or 0.0
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


def _margin_of_decay(decay_rate_1_s: float, period_s: float, limit: ChainLimit) -> float:
    """The largest margin (s) of gains that decay this fast, 0 if none do; decay slows as the margin grows."""
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
    """Message naming the parts in conflict, and how far each would have to be relaxed on its own."""
    given = [part for part in parts_of(wanted) if part.at_least]
    reached = [(part.name, rounded(_most(part.name, wanted, period_s), up=False)) for part in given]
    lower = [f"lower {name} to {most:g}" for name, most in reached if most > 0.0]
    unlimited = replace(wanted, string_peak_max=None)
    if wanted.string_peak_max is not None and _best_gains(unlimited, period_s) is not None:
        lower.append(f"raise string_peak_max = {wanted.string_peak_max:g}")
    named = " and ".join(f"{part.name} = {part.wanted_text}" for part in given)
    conflict = "exclude each other" if len(given) > 1 else "cannot be reached"
    advice = " or ".join(lower) if lower else "lower more than one of them" if len(given) > 1 else "lower period_s"
    return f"{named} {conflict} with period_s = {period_s:g}: {advice}"


def _most(name: str, wanted: Requirement, period_s: float) -> float:
    """The largest value of one part of the requirement at which the other parts can be met; 0 if none."""
    limit, margin_s = wanted.chain_limit, wanted.delay_margin_s or 0.0
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


def requirement_with(requirement: Requirement, response: Response | None, *, timing: Timing) -> Requirement:
    """Return the requirement whose design has the wanted margin on vehicles with this response, at these periods.

    The design assumes vehicles that respond at once and a single period, the slower one, so its requirement must have a
    longer margin, which false position finds. A requirement without a margin is returned unchanged. InfeasibleError if
    no gains have the wanted margin with this response and these periods.

    A requirement without a delay margin stays as it is:

    >>> wanted = Requirement(alpha=0.4)
    >>> requirement_with(wanted, Response(0.1, 0.0), timing=Timing(0.02, 0.02)) == wanted
    True
    """
    wanted_s = requirement.delay_margin_s
    if wanted_s is None or (response is None and timing.commands == 1):
        return requirement

    responses, lag_s = (None, timing.faster_s)
    if response is not None:
        responses, lag_s = [response] * 2, response.lag_s + response.dead_time_s

    def excess(without_s: float) -> float:
        found = largest_alpha(without_s, timing.held_s, requirement.chain_limit, requirement.decay_rate_1_s or 0.0)
        if found is None:
            return -wanted_s
        if response is not None and response.dead_time_s and timing.commands == 1:  # sampled_margin is too slow here
            alone_s = (lone_margin(found.k1, k3, response, period_s=timing.held_s) for k3 in (0.0, found.k3))
            return min(alone_s) - wanted_s
        return sampled_margin(PAIR, found.K, responses, timing=timing) - wanted_s

    # the response reduces the margin by about its lag
    low, high = wanted_s, wanted_s + lag_s
    f_low, f_high = excess(low), excess(high)
    while f_high < 0.0 and high < DELAY_MARGIN_MAX_S:
        low, f_low, high = high, f_high, min(high + wanted_s + lag_s, DELAY_MARGIN_MAX_S)
        f_high = excess(high)
    if f_high < 0.0 or high > DELAY_MARGIN_MAX_S:
        answer = ""
        if response:
            late = f", dead_time_s = {response.dead_time_s}" if response.dead_time_s else ""
            answer = f" with lag_s = {response.lag_s}{late} and velocity_gain_1_s = {response.velocity_gain_1_s}"
        raise InfeasibleError(f"no gains have a sampled delay margin of {wanted_s} s{answer}; ask for less")
    if f_low >= 0.0:
        return requirement
    found_s = met_end(excess, (high, f_high), (low, f_low), resolution=_MARGIN_RESOLUTION * wanted_s)
    return replace(requirement, delay_margin_s=found_s)
