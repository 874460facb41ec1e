"""`gcs design --front` and `--at`: the best gains at a loop delay, by every route, with and without prediction.

`--compare-prediction`: how much more loop delay prediction allows. Slow gains tolerate a long delay, so delays are
compared at equal decay, that of the scenario's gains with prediction. Without prediction, the delay is the longest at
which some static gains decay that fast. With prediction, it is the longest assumed delay at which some gains that decay
that fast (if vehicles respond with a lag, only the scenario's own) keep the loop stable at every constant delay within
a share of it. The static gains have the same string peak as these; if vehicles respond with a lag, a larger one.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

from gains.core.requirement import plain
from gains.criteria.predicted import PredictedFigures
from gains.design.for_delay import longest_static_delay
from gains.design.front import AIMS, Aim, FrontPoint, FrontSearch, Method, Refusal, Route, efficient
from gains.design.predicted import least_gains, longest_assumed_s
from gains.performance.scalar_gains import PAIR, ScalarGains
from gcs.errors import InputError
from gcs.plan.design import Design, GainsAtDelay
from gcs.plan.flight_plan import given_response, loop_timing
from gcs.plan.formation import plan_formation
from gcs.plan.given import with_gain, with_given
from gcs.plan.planner import pattern_of
from gcs.published import Published
from gcs.stress.campaign import local_workers
from gcs.views.page import figure_of, saved
from gcs.watch.for_link import evaluated
from scenarios.keys.part import PREDICTION_MAX_S
from scenarios.requirements import response_wanted
from scenarios.schema import FixedGains, Scenario

METHODS: tuple[Method, ...] = ("inclusion", "graph-lqr")
DELAYS_S = 0.1, 0.3, 0.6, 1.5
MOST_VEHICLES = 12
"""The figures are computed for the whole formation, which takes minutes for larger ones."""
Prediction = Literal["on", "off"]
TOLERATED = 0.2, 0.1, 0.05, 0.03
"""Shares of the delay by which the true delay may differ from the assumed one, each compared."""
# the share at which the scenario's own gains are compared, too
_OWN_TOLERATED = 0.05
# k2 as a share of k1 in all other gains; neither decay nor stability depends on it
_FRONT_SHARE = 0.2
_COLOURS = {"inclusion": "#1f4e79", "graph-lqr": "#c1440e"}
_FIGURES = {
    "alpha": "α of the whole formation, 1/s",
    "decay_rate_1_s": "decay, 1/s",
    "string_peak": "string peak",
    "spacing_gain_s2": "disturbance to spacing error, s²",
    "noise_gain": "noise to command",
}
_AIM_NAMES: dict[Aim, str] = {"alpha_at_delay": "alpha", "decay_rate_at_delay_1_s": "decay"}


class FrontFields(Published):
    """A front as --json prints it."""

    scenario: str
    tolerated: float
    string_peak_max: float
    points: tuple[GainsAtDelay, ...]


def front(
    scenario: Scenario,
    methods: Sequence[Method] = METHODS,
    delays_s: Sequence[float] = DELAYS_S,
    *,
    workers: int = 1,
    ended: Callable[[int], None] = lambda _: None,
) -> FrontFields:
    """The gains of largest alpha and of fastest decay at each delay (s), by each method, with and without prediction.

    `workers` processes search; `ended` is called after each point with the number left. Raises InputError where a front
    is not defined.
    """
    search, routes = searched_in(scenario, methods), [Route(*each) for each in product(methods, (False, True), AIMS)]
    left, found = len(routes) * len(delays_s), list[FrontPoint | Refusal]()
    with local_workers(workers, search.point) as each:
        for one in each([(route, delay_s) for delay_s in delays_s for route in routes]):
            found.append(one)
            left -= 1
            ended(left)
    points = efficient([one for one in found if isinstance(one, FrontPoint)])
    every = [fields_of(one) for one in (*points, *(one for one in found if isinstance(one, Refusal)))]
    every.sort(key=lambda own: (own.loop_delay_s, own.maximised, own.method, own.prediction))
    return FrontFields(
        scenario=scenario.name,
        tolerated=search.tolerated,
        string_peak_max=scenario.control.string_peak_max,
        points=tuple(every),
    )


def searched_in(scenario: Scenario, methods: Sequence[Method]) -> FrontSearch:
    """The search for a scenario's front by these methods. Raises InputError where a front is not defined."""
    response, dynamics = given_response(scenario), scenario.dynamics
    for read, given, wanted in (
        ("loop onboard", scenario.control.loop == "onboard", "loop ground"),
        (f"dynamics {dynamics}", dynamics != "double_integrator" and response is None, response_wanted(dynamics)),
        ("graph-lqr and a [response]", response is not None and "graph-lqr" in methods, "--method inclusion"),
    ):
        if given:
            raise InputError(f"{scenario.name}: read {read}, wanted {wanted}, with --front or --at")
    if len(scenario.vehicles) > MOST_VEHICLES:
        wanted = f"at most {MOST_VEHICLES} with --front or --at; gains by inclusion are those of a smaller formation"
        raise InputError(f"{scenario.name}: read {len(scenario.vehicles)} vehicles, wanted {wanted}")
    formation = plan_formation(scenario)
    return FrontSearch(
        formation.model,
        pattern_of(scenario.with_keys(control={"blocks": ()}), formation),
        loop_timing(scenario).held_s,
        string_peak_max=scenario.control.string_peak_max,
        response=response,
    )


def point_at(
    scenario: Scenario, delay_s: float, method: Method, aim: Aim, prediction: Prediction | None
) -> tuple[Scenario, GainsAtDelay]:
    """The scenario with the gains of a point of the front; `prediction` None takes the better of on and off.

    Raises InputError if no gains take the delay.
    """
    predicted = (False, True) if prediction is None else (prediction == "on",)
    search = searched_in(scenario, (method,))
    found = [search.point((Route(method, own, aim), delay_s)) for own in predicted]
    points = [own for own in found if isinstance(own, FrontPoint)]
    if not points:
        reasons = "; ".join(own.reason for own in found if isinstance(own, Refusal))
        raise InputError(f"--at: read {delay_s:g} s, wanted a loop delay that gains take: {reasons}")
    best = max(points, key=lambda own: own.alpha if aim == "alpha_at_delay" else own.decay_rate_1_s)
    late: float | Literal["off"] = delay_s if best.route.predicted else "off"
    if method != "inclusion":
        return with_gain(scenario, best.K, prediction=late), fields_of(best)
    k1, k2, k3 = _inclusion(best)
    return with_given(scenario, gains=FixedGains(K1=k1, K2=k2, K3=k3), prediction=late), fields_of(best)


def _inclusion(point: FrontPoint) -> tuple[float, float, float]:
    """K1, K2 and K3 of a gain by inclusion; a lone leader has only K1."""
    K = point.K
    return (float(K[0, 0]), 0.0, 1.0) if len(K) == 1 else (float(K[1, 2]), float(K[1, 0]), float(K[1, 1]))


def fields_of(found: FrontPoint | Refusal) -> GainsAtDelay:
    """The printed fields of a point, or of the reason why there is none."""
    method, prediction, aim = found.route
    named = {"method": method, "prediction": prediction, "maximised": _AIM_NAMES[aim], "loop_delay_s": found.delay_s}
    if isinstance(found, Refusal):
        return GainsAtDelay.model_validate(named | {"refused": found.reason})
    figures = {name: value for name, value in vars(found).items() if name in GainsAtDelay.model_fields}
    return GainsAtDelay.model_validate(named | plain(figures))


class Comparison(Published):
    """The worth and the cost of prediction at the decay of a scenario's gains."""

    scenario: str
    ways: tuple[GainsAtDelay, ...]


def compared(design: Design, name: str) -> Comparison:
    """Compare prediction with none at a design's decay. InputError unless the design is by inclusion and stable."""
    answers = set(design.responses.values())
    if design.inclusion_gains is None or design.onboard is not None or len(answers) != (design.response is not None):
        wanted = "one by inclusion, loop ground, and [response] if vehicles have an autopilot"
        raise InputError(f"{name}: read another design, wanted {wanted}")
    K1, K2, K3 = (float(gain[0, 0]) for gain in design.inclusion_gains)
    period_s, own, response = design.period_s, ScalarGains(-K1, K2, K3, 0.0), next(iter(answers), None)

    def decay_1_s(gains: ScalarGains, assumed_s: float, *delays_s: float) -> float:
        figures = PredictedFigures(PAIR, gains.K, period_s, assumed_s, delays_s, response=response)
        return figures.decay_rate_at_delay_1_s

    wanted_1_s = decay_1_s(own, period_s, period_s)
    late_s, fastest = longest_static_delay(wanted_1_s, period_s, response) if wanted_1_s > 0.0 else (0.0, own)
    if late_s <= 0.0:
        raise InputError(f"{name}: read gains that decay at {wanted_1_s:.3g} 1/s, wanted slower ones that are stable")

    def way(chosen: str, gains: ScalarGains, share: float | None) -> GainsAtDelay:
        delay_s, assumed_s, half_way_1_s = late_s, None, None
        if share is not None:
            delay_s = assumed_s = longest_assumed_s(gains, period_s, share, PREDICTION_MAX_S, response)
            half_way_1_s = decay_1_s(gains, delay_s, (1.0 - share / 2.0) * delay_s, (1.0 + share / 2.0) * delay_s)
        whose = {"gains": chosen, "tolerated": share, "loop_delay_s": delay_s, "ratio": delay_s / late_s}
        found = evaluated(gains, period_s, assumed_s, (delay_s, delay_s), response)
        return found.model_copy(update=whose | {"decay_rate_half_way_1_s": half_way_1_s})

    predicted = [("own", own, share) for share in (TOLERATED if response else (_OWN_TOLERATED,))]
    if response is None:  # no other gains that decay as fast tolerate more than these
        k1, k3 = least_gains(wanted_1_s, period_s)
        least = ScalarGains(k1, _FRONT_SHARE * k1, k3, 0.0)
        predicted = [*(("least", least, share) for share in TOLERATED), *predicted]
    ways = way("fastest", replace(fastest, k2=_FRONT_SHARE * fastest.k1), None), *(way(*each) for each in predicted)
    return Comparison(scenario=name, ways=tuple(own for own in ways if own.loop_delay_s))


def plot_front(found: FrontFields, figure: str, axes: Any) -> Any:
    """Draw one figure of a front's points over the loop delay into matplotlib's `axes`, and return them.

    `figure` is `alpha`, `decay_rate_1_s`, `string_peak`, `spacing_gain_s2` or `noise_gain`.
    """
    if figure not in _FIGURES:
        raise InputError(f"figure: read {figure!r}, wanted one of {', '.join(_FIGURES)}")
    scale = "linear" if figure in {"alpha", "string_peak"} else "log"
    delays_s = sorted({point.loop_delay_s for point in found.points})
    axes.set(title=_FIGURES[figure], xlabel="loop delay, ms", xscale="log", yscale=scale)
    axes.set_xticks(delays_s, [f"{1e3 * delay_s:g}" for delay_s in delays_s])
    axes.set_xticks([], minor=True)
    for method, predicted, aim in product(METHODS, (False, True), _AIM_NAMES.values()):
        own = [p for p in found.points if (p.method, p.prediction, p.maximised) == (method, predicted, aim)]
        own = [p for p in own if getattr(p, figure) is not None]
        if own:
            label = f"{method}, {'predicted' if predicted else 'not predicted'}, largest {aim}"
            style = {"marker": "o" if aim == "alpha" else "s", "linestyle": "-" if predicted else "--"}
            values = [getattr(p, figure) for p in own]
            axes.plot([p.loop_delay_s for p in own], values, color=_COLOURS[method], label=label, markersize=4, **style)
    return axes


def picture(found: FrontFields, file: Path) -> Path:
    """Draw a front, figures of its points over the loop delay, as PNG, SVG or PDF by the extension of the file."""
    figure, plots = figure_of(2, (10.0, 7.0), (1.0, 1.0), columns=2)
    for plot, name in zip(plots.flat, _FIGURES, strict=False):
        plot_front(found, name, plot)
    figure.legend(*plots[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2, handlelength=4)
    return saved(figure, file)
