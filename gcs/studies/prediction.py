"""`gcs design --compare-prediction`: the loop delay that gains take with prediction, against any without it.

Slow gains take a long delay, so delays are compared at equal decay and string peak: the longest at which any static
gains decay as fast as those of the scenario do with prediction, and the longest over which a station can predict with
these, stable at every constant delay within a share of it.
"""

from collections.abc import Callable
from math import inf, sqrt

from gains.criteria.figures import LoopFigures
from gains.criteria.predicted import PredictedFigures
from gains.design.for_delay import fastest_at_delay
from gains.formation.model import FormationModel
from gains.performance.flown import FlownLoop, FlownTiming
from gains.performance.scalar_gains import ScalarGains
from gcs.errors import InputError
from gcs.plan.design import Design
from gcs.published import Published
from scenarios.keys.part import PREDICTION_MAX_S

TOLERATED = 0.2, 0.1, 0.05, 0.03
_STEPS = 12
# k2 as a share of k1, in gains without prediction
_FRONT_SHARE = 0.2


class Compared(Published):
    """One way to take a loop delay, with its figures there; both ways decay alike."""

    prediction: bool
    tolerated: float | None = None
    loop_delay_s: float
    ratio: float
    stable_s: tuple[float, float]
    decay_rate_1_s: float
    string_peak: float
    alpha: float
    spacing_gain_s2: float
    noise_gain: float


class Comparison(Published):
    """What the prediction of a scenario's gains is worth, and what it costs."""

    scenario: str
    ways: tuple[Compared, ...]


def compared(design: Design, name: str) -> Comparison:
    """The comparison for the gains of a design. Raises InputError if it is not one by inclusion of stable gains."""
    if design.inclusion_gains is None or design.loop != "ground" or design.response is not None:
        raise InputError(
            f"{name}: read another design, wanted one by inclusion, loop ground, of vehicles without a lag"
        )
    own, front, spacing = (gain[0][0] for gain in design.inclusion_gains)
    chain, period_s = ScalarGains(-own, front, spacing, 0.0), design.period_s

    def predicted(assumed_s: float) -> PredictedFigures:
        model = FormationModel((-1, 0), axes=1)
        K = model.overlapping_gain([[own]], [[front]], [[spacing]])
        return PredictedFigures(model, K, period_s, assumed_s, (assumed_s,), chain=chain)

    wanted_1_s = predicted(period_s).decay_rate_at_delay_1_s
    late_s = (2.0 - sqrt(2.0)) / wanted_1_s - period_s / 2.0
    if not (wanted_1_s > 0.0 and late_s > 0.0):
        raise InputError(f"{name}: read gains that decay at {wanted_1_s:.3g} 1/s, wanted slower ones that are stable")
    plain = _unpredicted(late_s, period_s)
    ways = [_fields(plain, late_s, late_s, (0.0, plain.delay_margin_s))]
    for share in TOLERATED:
        longest_s = _longest(share, predicted)
        if longest_s > 0.0:
            figures = predicted(longest_s)
            ways.append(_fields(figures, longest_s, late_s, figures.window_s, share))
    return Comparison(scenario=name, ways=tuple(ways))


def _unpredicted(late_s: float, period_s: float) -> LoopFigures:
    """The gains that decay fastest at a loop delay without prediction: no static gains decay faster."""
    k1, k3 = fastest_at_delay(late_s + period_s / 2.0)
    gains, timing = ScalarGains(k1, _FRONT_SHARE * k1, k3, 0.0), FlownTiming(inf, period_s)
    model = FormationModel((-1, 0), axes=1)
    K = model.overlapping_gain([[-k1]], [[gains.k2]], [[k3]])
    return LoopFigures(model, K, timing, late_s, chain=FlownLoop(gains, timing))


def _longest(share: float, predicted: Callable[[float], PredictedFigures]) -> float:
    """The longest assumed delay (s) whose window reaches by a share of it to either side; 0 if none does."""

    def takes(assumed_s: float) -> bool:
        least_s, most_s = predicted(assumed_s).window_s
        return (least_s <= (1.0 - share) * assumed_s or least_s == 0.0) and most_s >= (1.0 + share) * assumed_s

    low_s, high_s = 0.0, PREDICTION_MAX_S
    for _ in range(_STEPS):
        middle_s = (low_s + high_s) / 2.0
        low_s, high_s = (middle_s, high_s) if takes(middle_s) else (low_s, middle_s)
    return low_s


def _fields(
    figures: LoopFigures | PredictedFigures,
    delay_s: float,
    plain_s: float,
    stable_s: tuple[float, float],
    share: float | None = None,
) -> Compared:
    return Compared(
        prediction=share is not None,
        tolerated=share,
        loop_delay_s=delay_s,
        ratio=delay_s / plain_s,
        stable_s=stable_s,
        decay_rate_1_s=figures.decay_rate_at_delay_1_s,
        string_peak=figures.string_peak,
        alpha=figures.alpha_at_delay,
        spacing_gain_s2=figures.spacing_gain_max_s2,
        noise_gain=figures.noise_gain_max,
    )
