"""Gains on any information pattern, designed to a requirement: the graph route.

A base gain comes from the structured LQR (`gains.design.structured_lqr`) or the D-K type iteration
(`gains.design.dk_iteration`), for one axis; the other axes get the same. It is then brought to the requirement by a
change of the time scale, which keeps its pattern: a loop of double integrators with velocity gains K_v / s and spacing
gains K_p / s² does the same things s times slower, so that its continuous delay margin is s times larger and its decay
rate s times smaller, exactly. The margin that is asked for is the sampled one, found by a few steps of a fixed-point
iteration on s, as it is the continuous one less half a period to first order.

The margin asked for is that of the loop that is flown. On board only the errors of other vehicles are late, and gains
may rise without bound while the margin lasts; a pattern without cycles takes every delay. So there the vehicles' own
gains must have the margin too, as if a ground station closed their loops, which is what bounds inclusion gains on
board. Both margins change with the time scale as that of the ground loop does.

What a slower or faster loop cannot give, its shape may: for the LQR route several ratios of the weights of spacing and
velocity errors are tried, and the best in what the requirement leaves open is kept.

Source: Sahoo 2012 (see `gains.formation.model`), section 4. The scaling to a requirement is ours.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from gains.core._semidefinite import SolverFacts
from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError, InfeasibleError, SolverError
from gains.core.requirement import Requirement, plain
from gains.delay.constant import delay_margin
from gains.design.dk_iteration import DecayProof, abscissa, decay_proof
from gains.formation.bipartite import partition_by_input, smallest_partition
from gains.formation.fixed_modes import check_stabilisable
from gains.formation.model import FormationModel
from gains.formation.pattern import Link, Pattern, Plant, checked_pattern_gain, formation_plant
from gains.performance.robust import disturbance_bound
from gains.sampled.constant import sampled_delay_margin
from gains.sampled.onboard import OnboardTiming, onboard_loop, own_part

GraphMethod = Literal["graph-dk", "graph-lqr"]

# Ratios of the weight of spacing errors (1/m²) to that of velocity errors (s²/m²), in the unit of time of the base.
_WEIGHT_RATIOS = tuple(float(ratio) for ratio in np.geomspace(0.03, 30.0, 9))
# The margin is met with at most this much to spare, as a share of it.
_SPARE = 1e-6
_SCALING_STEPS = 20
# Time scales looked at when only robustness or decay are asked for.
_SCALES = np.geomspace(1e-3, 1e3, 121)
# The decay rate that the certificate proves, as a share of the real one; less where the loop is nearly defective.
_PROVED_SHARES = (0.9, 0.5, 0.1, 0.01)


@dataclass(frozen=True, eq=False)
class GraphDesign:
    """A gain with an information pattern, what it is good for, and how that is known.

    Attributes
    ----------
    K
        u = K e, shape (inputs, states) of `gains.formation.model.FormationModel`.
    links
        The pattern: (i, j) where vehicle i uses the output of vehicle j, spacing and velocity error.
    alpha
        Exact sector bound of the whole formation for W = I: 1 / ‖(sI − A − BK)^{-1}‖∞. It is not that of one vehicle
        behind another, which `gains.design.design` reports, and falls with the length of a chain.
    decay_rate_1_s
        Of the slowest motion without delay; negative if unstable.
    delay_margin_s, delay_margin_continuous_s
        Margin of the sampled loop and of the continuous one, all feedback late.
    certificate
        P that proves a share of the decay rate, checked by eigenvalues; None if the loop is unstable.
    cost_loss
        Share by which the LQR cost is above that of the centralised optimum; None for other methods.
    subgraphs, subgraphs_smallest
        Complete bipartite subgraphs of the partition by input and of the smallest one found.
    solver
        Of the base gain; None where no solver was used.
    """

    K: FloatArray
    links: tuple[Link, ...]
    alpha: float
    decay_rate_1_s: float
    delay_margin_s: float
    delay_margin_continuous_s: float
    period_s: float
    vehicles: int
    certificate: DecayProof | None
    cost_loss: float | None
    subgraphs: int
    subgraphs_smallest: int
    solver: SolverFacts | None
    requirement: Requirement | None
    method: Literal["graph-dk", "graph-lqr", "given"]
    loop: Literal["ground"] = "ground"

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists, numbers and strings, for JSON; a number that is not finite becomes None."""
        return {name: plain(value) for name, value in asdict(self).items()}


@dataclass(frozen=True, eq=False)
class _Base:
    """A stabilising gain for one axis, with what does not depend on the time scale.

    `margin_s` is the continuous margin that a requirement bounds.
    """

    K: FloatArray
    margin_s: float
    decay_rate_1_s: float
    cost_loss: float | None
    solver: SolverFacts | None


def graph_design(
    formation: FormationModel,
    pattern: Pattern,
    requirement: Requirement | None = None,
    *,
    method: GraphMethod,
    period_s: float,
    onboard: OnboardTiming | None = None,
) -> GraphDesign:
    """Return a gain with the pattern that meets the requirement, the best in what it leaves open.

    Parameters
    ----------
    formation, pattern
        The pattern is one of the formation with one axis or with all of them; D-K takes at most 40 states an axis.
    requirement
        As in `gains.design.design.design`; its `string_peak_max` is not used, as errors run both ways in a general
        pattern.
    method
        Where the base gain comes from.
    period_s
        Period of the control loop: sample, hold.
    onboard
        Timing of the onboard loop, if that is flown: its margin is then asked for, and that of the vehicles' own gains
        late by themselves. The margins reported are those of the ground loop in any case.

    Raises
    ------
    BadModelError
        If the pattern is not one of the formation, or the period is not positive.
    InfeasibleError
        If a mode cannot be moved by the pattern (the message names the missing link), or the requirement cannot be met
        (the message says what to relax).
    SolverError
        If the base gain is not found: see `gains.design.structured_lqr` and `gains.design.dk_iteration`.

    Examples
    --------
    A chain of three in which each vehicle sees its neighbours on both sides:

    >>> from gains.formation.model import FormationModel
    >>> from gains.design.graph import graph_design
    >>> from gains.formation.pattern import bidirectional
    >>> chain = FormationModel((-1, 0, 1))
    >>> found = graph_design(chain, bidirectional(chain), method="graph-lqr", period_s=0.02)
    >>> round(found.delay_margin_s, 6), found.K.shape
    (0.3, (6, 10))
    """
    wanted = requirement or Requirement()
    single = FormationModel(formation.predecessors, axes=1)
    plant, narrow = formation_plant(single), _narrowed(pattern, single)
    check_stabilisable(plant, narrow)
    found = _lqr_gains(plant, narrow, single) if method == "graph-lqr" else _dk_gains(plant, narrow)
    loop = _FlownLoop(single, period_s, onboard)
    bases = [base for gain in found if (base := _base(loop, *gain)).margin_s > 0.0]
    if not bases:
        raise InfeasibleError(
            "no gains on this pattern leave each vehicle stable by its own errors alone, as the onboard loop wants"
        )
    if wanted.delay_margin_s is not None:
        base, scale = _at_margin(loop, bases, wanted)
    else:
        base, scale = _slowest(loop, bases, wanted)
    gain = time_scaled(single, base.K, scale)
    return _assess(
        formation, narrow, gain, period_s=period_s, requirement=wanted, method=method, loss=base.cost_loss,
        solver=base.solver,
    )  # fmt: skip


def evaluate_graph_gain(formation: FormationModel, pattern: Pattern, K: ArrayLike, *, period_s: float) -> GraphDesign:
    """Return margins, robustness and decay rate of a given gain K (inputs, states) with a pattern.

    Gains of an unstable loop are reported too: alpha and the margins are 0 and there is no certificate.

    Raises
    ------
    BadModelError
        If K does not have the pattern, or the period is not positive.

    Examples
    --------
    >>> from gains.formation.model import FormationModel
    >>> from gains.design.graph import evaluate_graph_gain
    >>> from gains.formation.pattern import leader_follower
    >>> pair = FormationModel((-1, 0), axes=1)
    >>> found = evaluate_graph_gain(pair, leader_follower(pair), [[-1, 0, 0], [0, 1, -1]], period_s=0.02)
    >>> round(found.delay_margin_continuous_s, 6), round(found.decay_rate_1_s, 6)
    (0.711119, 0.5)
    """
    gain = checked_pattern_gain(pattern, K)
    return _assess(
        formation, pattern, gain, period_s=period_s, requirement=None, method="given", loss=None, solver=None
    )


def time_scaled(formation: FormationModel, K: FloatArray, scale: float) -> FloatArray:
    """The gain with which the loop does the same `scale` times slower: K_v / scale, K_p / scale².

    K is of shape (any, states): K_v are its columns of velocity errors, K_p those of spacing errors.

    Examples
    --------
    >>> import numpy as np
    >>> from gains.formation.model import FormationModel
    >>> from gains.design.graph import time_scaled
    >>> time_scaled(FormationModel((-1, 0), axes=1), np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, -1.0]]), 2.0).tolist()
    [[-0.5, 0.0, 0.0], [0.0, 0.25, -0.5]]
    """
    scaled = K / scale
    for i in formation.followers:
        scaled[:, formation.spacing_slice(i)] /= scale
    return scaled


def _narrowed(pattern: Pattern, single: FormationModel) -> Pattern:
    """The same blocks for one axis."""
    if pattern.blocks.shape != (single.vehicles, single.vehicles):
        raise BadModelError(
            f"the pattern has {pattern.blocks.shape} blocks; wanted {(single.vehicles, single.vehicles)}"
        )
    inputs = (1,) * single.vehicles
    outputs = (1, *(2,) * (single.vehicles - 1))
    return Pattern(pattern.blocks, inputs, outputs)


_Found = tuple[FloatArray, float | None, SolverFacts | None]
"""A base gain, its loss of cost and what the solver did."""


def _lqr_gains(plant: Plant, pattern: Pattern, single: FormationModel) -> Iterable[_Found]:
    from gains.design.lqr import Weights
    from gains.design.structured_lqr import structured_lqr

    for ratio in _WEIGHT_RATIOS:
        weight = np.ones(single.states)
        for i in single.followers:
            weight[single.spacing_slice(i)] = ratio
        found = structured_lqr(plant, pattern, Weights(np.diag(weight), np.eye(single.inputs)))
        yield found.K, found.loss, None


def _dk_gains(plant: Plant, pattern: Pattern) -> Iterable[_Found]:
    from gains.design.dk_iteration import dk_iteration

    found = dk_iteration(plant, pattern)
    yield found.K, None, found.solver


def _base(loop: "_FlownLoop", K: FloatArray, loss: float | None, solver: SolverFacts | None) -> _Base:
    return _Base(K, loop.continuous_margin_s(K), -abscissa(loop.model.A + loop.model.B @ K), loss, solver)


@dataclass(frozen=True)
class _FlownLoop:
    """Where the loop is closed: the margins of a gain for one axis that a requirement bounds."""

    model: FormationModel
    period_s: float
    onboard: OnboardTiming | None

    def continuous_margin_s(self, K: FloatArray) -> float:
        A, B = self.model.A, self.model.B
        if self.onboard is None:
            return delay_margin(A, B @ K)
        own_s = delay_margin(A, B @ own_part(self.model, K))
        return min(own_s, onboard_loop(self.model, K, self.onboard).continuous_margin_s())

    def sampled_margin_s(self, K: FloatArray) -> float:
        A, B = self.model.A, self.model.B
        if self.onboard is None:
            return float(sampled_delay_margin(A, B, K, period_s=self.period_s))
        own_s = sampled_delay_margin(A, B, own_part(self.model, K), period_s=self.period_s)
        return float(min(own_s, onboard_loop(self.model, K, self.onboard).sampled_margin_s()))


def _at_margin(loop: _FlownLoop, bases: Sequence[_Base], wanted: Requirement) -> tuple[_Base, float]:
    """The most robust base that meets everything else, brought to the wanted margin."""
    margin_s, single, period_s = wanted.delay_margin_s, loop.model, loop.period_s
    assert margin_s is not None
    reached: list[tuple[float, float, _Base, float]] = []
    for base in bases:
        scale = (margin_s + period_s / 2.0) / base.margin_s  # exact but for terms in the square of the period
        reached.append((_alpha(single, base, scale), base.decay_rate_1_s / scale, base, scale))
    fitting = [entry for entry in reached if _meets(entry[0], entry[1], wanted)]
    if not fitting:
        alpha, decay = max(entry[0] for entry in reached), max(entry[1] for entry in reached)
        raise InfeasibleError(
            f"with delay_margin_s = {margin_s} this pattern does not reach {_asked(wanted)}: "
            f"{_reached(alpha, decay, wanted)} at most; lower that, or delay_margin_s"
        )
    _, _, base, scale = max(fitting, key=lambda entry: entry[0])
    for _ in range(_SCALING_STEPS):
        found_s = loop.sampled_margin_s(time_scaled(single, base.K, scale))
        if margin_s <= found_s <= margin_s * (1.0 + _SPARE):
            return base, scale
        scale *= (margin_s * (1.0 + _SPARE / 2.0) + period_s / 2.0) / (found_s + period_s / 2.0)
    raise InfeasibleError(
        f"no time scale brings the sampled margin to delay_margin_s = {margin_s} with period_s = {period_s}; lower "
        "period_s or raise delay_margin_s"
    )


def _slowest(loop: _FlownLoop, bases: Sequence[_Base], wanted: Requirement) -> tuple[_Base, float]:
    """The base and time scale of largest margin that reach the wanted robustness and decay rate."""
    single, period_s = loop.model, loop.period_s

    def good(base: _Base, scale: float) -> bool:
        return _meets(_alpha(single, base, scale), base.decay_rate_1_s / scale, wanted)

    best: tuple[float, _Base, float] | None = None
    for base in bases:
        fitting = [float(scale) for scale in _SCALES if good(base, float(scale))]
        if not fitting:
            continue
        low = max(fitting)
        scale = _last_good(lambda s, base=base: good(base, s), low, low * float(_SCALES[1] / _SCALES[0]))
        if best is None or base.margin_s * scale > best[0]:
            best = base.margin_s * scale, base, scale
    if best is None or loop.sampled_margin_s(time_scaled(single, best[1].K, best[2])) == 0.0:
        flown = [(base, float(scale)) for base in bases for scale in _SCALES if base.margin_s * scale > period_s / 2.0]
        alpha = max(_alpha(single, base, scale) for base, scale in flown)
        decay = max(base.decay_rate_1_s / scale for base, scale in flown)
        raise InfeasibleError(
            f"this pattern does not reach {_asked(wanted)} with period_s = {period_s}, however small the delay margin: "
            f"{_reached(alpha, decay, wanted)} at most; lower that, or period_s, or add links"
        )
    return best[1], best[2]


def _last_good(good: Callable[[float], bool], low: float, high: float) -> float:
    """The largest number found good between one that is and one that is not."""
    for _ in range(40):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if good(middle) else (low, middle)
    return low


def _meets(alpha: float, decay_rate_1_s: float, wanted: Requirement) -> bool:
    return alpha >= (wanted.alpha or 0.0) and decay_rate_1_s >= (wanted.decay_rate_1_s or 0.0)


def _asked(wanted: Requirement) -> str:
    asked = {"alpha": wanted.alpha, "decay_rate_1_s": wanted.decay_rate_1_s}
    return " and ".join(f"{name} = {value}" for name, value in asked.items() if value is not None)


def _reached(alpha: float, decay_rate_1_s: float, wanted: Requirement) -> str:
    """The most that was reached of each thing asked for."""
    reached = [f"alpha = {alpha:.4f}"] if wanted.alpha is not None else []
    reached += [f"decay_rate_1_s = {decay_rate_1_s:.4f}"] if wanted.decay_rate_1_s is not None else []
    return " or ".join(reached)


def _alpha(single: FormationModel, base: _Base, scale: float) -> float:
    return disturbance_bound(single.A + single.B @ time_scaled(single, base.K, scale), np.eye(single.states))


def _assess(
    formation: FormationModel,
    pattern: Pattern,
    K: FloatArray,
    *,
    period_s: float,
    requirement: Requirement | None,
    method: Literal["graph-dk", "graph-lqr", "given"],
    loss: float | None,
    solver: SolverFacts | None,
) -> GraphDesign:
    """Everything that is reported of a gain for one axis, or for all."""
    if not (isfinite(period_s) and period_s > 0.0):
        raise BadModelError(f"period_s = {period_s}; wanted a positive number of seconds")
    narrow = K.shape[0] == formation.vehicles and formation.axes > 1
    model = FormationModel(formation.predecessors, axes=1) if narrow else formation
    A, B = model.A, model.B
    closed_loop = A + B @ K
    decay = -abscissa(closed_loop)
    stable = decay > 0.0
    return GraphDesign(
        K=np.kron(K, np.eye(formation.axes)).astype(np.float64) if narrow else K,
        links=pattern.links,
        alpha=disturbance_bound(closed_loop, np.eye(model.states)) if stable else 0.0,
        decay_rate_1_s=decay,
        delay_margin_s=float(sampled_delay_margin(A, B, K, period_s=period_s)),
        delay_margin_continuous_s=delay_margin(A, B @ K),
        period_s=period_s,
        vehicles=formation.vehicles,
        certificate=_certificate(closed_loop, decay) if stable else None,
        cost_loss=loss,
        subgraphs=len(partition_by_input(pattern).subgraphs),
        subgraphs_smallest=len(smallest_partition(pattern).subgraphs),
        solver=solver,
        requirement=requirement,
        method=method,
    )


def _certificate(closed_loop: FloatArray, decay_rate_1_s: float) -> DecayProof | None:
    """A proof of the largest share of the decay rate that can be proved: P of A_K'P + P A_K + 2 r P = −I."""
    identity = np.eye(len(closed_loop))
    for share in _PROVED_SHARES:
        shifted = closed_loop + share * decay_rate_1_s * identity
        P: FloatArray = np.real(linalg.solve_continuous_lyapunov(shifted.T, -identity)).astype(np.float64)
        try:
            return decay_proof(closed_loop, (P + P.T) / 2.0)
        except SolverError:
            continue
    return None
