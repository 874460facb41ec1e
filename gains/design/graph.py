"""Gains on any information pattern, designed to a requirement: the graph route.

A base gain for one axis comes from the structured LQR (`gains.design.structured_lqr`) or the D-K type iteration
(`gains.design.dk_iteration`); the other axes get the same gain. A change of time scale makes it meet the requirement
(`gains.design.time_scale`). The LQR route tries several ratios of the weights of spacing and velocity errors, and keeps
the gain that meets the requirement and is otherwise best.

Source: Sahoo 2012 (see `gains.formation.model`), section 4. The scaling to a requirement is ours.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from math import inf
from typing import Any, Literal

import numpy as np
from scipy import linalg

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError, InfeasibleError, SolverError
from gains.core.requirement import Requirement, plain
from gains.core.semidefinite import SolverFacts
from gains.delay.constant import delay_margin
from gains.design.dk_iteration import DecayProof, abscissa, decay_proof, dk_iteration
from gains.design.for_delay import PatternGains, searched
from gains.design.lqr import Weights
from gains.design.structured_lqr import structured_lqr
from gains.design.time_scale import BaseGain, BoundedMargins, scaled_to
from gains.formation.bipartite import partition_by_input, smallest_partition
from gains.formation.fixed_modes import check_stabilisable
from gains.formation.model import FormationModel
from gains.formation.pattern import Link, Pattern, Plant, formation_plant
from gains.performance.flown import FlownTiming
from gains.performance.robust import disturbance_bound
from gains.sampled.constant import sampled_delay_margin
from gains.sampled.onboard import OnboardTiming

GraphMethod = Literal["graph-dk", "graph-lqr"]

# Ratios of the weight of spacing errors (1/m²) to that of velocity errors (s²/m²), in the time unit of the base gain.
_WEIGHT_RATIOS = np.geomspace(0.03, 30.0, 9).tolist()
# Shares of the decay rate that the certificate tries to prove; a nearly defective loop allows only a small one.
_PROVED_SHARES = (0.9, 0.5, 0.1, 0.01)


@dataclass(frozen=True, eq=False)
class GraphDesign:
    """A gain with an information pattern, its figures, and the evidence for them."""

    K: FloatArray
    """u = K e, shape (inputs, states) of `gains.formation.model.FormationModel`."""
    links: tuple[Link, ...]
    """The pattern: (i, j) if vehicle i uses the output of vehicle j, its spacing and velocity error."""
    alpha: float
    """Exact sector bound of the whole formation for W = I: 1 / ‖(sI − A − BK)^{-1}‖∞. It falls with the length of a
    chain, unlike the α of one vehicle behind another that `gains.design.design` reports for inclusion."""
    decay_rate_1_s: float
    """Decay rate of the slowest motion without delay; negative if unstable."""
    delay_margin_s: float
    delay_margin_continuous_s: float
    """Margins of the sampled and of the continuous loop, with all feedback late."""
    period_s: float
    vehicles: int
    certificate: DecayProof | None
    """P that proves a share of the decay rate, checked by eigenvalues; None if the loop is unstable or P not found."""
    cost_loss: float | None
    """Relative excess of the LQR cost over the centralised optimum; None for other methods and with criteria."""
    subgraphs: int
    subgraphs_smallest: int
    """Numbers of complete bipartite subgraphs in the partition by input and in the smallest one found."""
    solver: SolverFacts | None
    """The solver's facts for the base gain; None if no solver was used, and with criteria."""
    requirement: Requirement | None
    method: Literal["graph-dk", "graph-lqr", "given"]
    loop: Literal["ground"] = "ground"

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists, numbers and strings, for JSON; a number that is not finite becomes None."""
        return {name: plain(value) for name, value in asdict(self).items()}


def graph_design(
    formation: FormationModel,
    pattern: Pattern,
    requirement: Requirement | None = None,
    *,
    method: GraphMethod,
    period_s: float,
    onboard: OnboardTiming | None = None,
) -> GraphDesign:
    """Return the gain with the pattern that meets the requirement and is otherwise best.

    Arguments are those of `gains.design.design.design`, except that the requirement's `string_peak_max` is not used,
    because errors run both ways in a general pattern. D-K takes at most 40 states per axis. With `onboard`, the timing
    of the onboard loop, the requirement bounds the margin of that loop and that of the vehicles' own gains
    (`gains.design.time_scale`). The reported margins are always those of the ground loop.

    Raises BadModelError if the pattern does not fit the formation or the period is not positive; InfeasibleError if the
    pattern cannot move a mode, naming the missing link, or the requirement cannot be met, saying what to relax;
    SolverError if the base gain is not found (`gains.design.structured_lqr`, `gains.design.dk_iteration`).
    """
    wanted = requirement or Requirement()
    single, narrow, plant = _narrowed(formation, pattern)
    margins = BoundedMargins(single, period_s, onboard)
    every = [
        BaseGain(K, margins.continuous_s(K), -abscissa(single.A + single.B @ K), loss, facts)
        for K, loss, facts in _base_gains(plant, narrow, single, method)
    ]
    bases = [base for base in every if base.margin_s > 0.0]
    if not bases:
        raise InfeasibleError(
            "no gains on this pattern leave each vehicle stable by its own errors alone, as the onboard loop requires"
        )
    if wanted.criteria is not None:
        asked, starts = wanted.criteria, tuple(base.K for base in bases)
        timing = FlownTiming(inf, period_s)
        family = PatternGains(single, narrow.mask, starts, asked.at_delay_s, timing, asked.weight, asked.discrete)
        gain = family.gain(searched(family, replace(wanted, string_peak_max=None))[0])
        return assess(formation, narrow, gain, period_s=period_s, requirement=wanted, method=method)
    base, gain = scaled_to(wanted, margins, bases)
    return assess(
        formation, narrow, gain, period_s=period_s, requirement=wanted, method=method, loss=base.cost_loss,
        solver=base.solver,
    )  # fmt: skip


def lqr_bases(formation: FormationModel, pattern: Pattern) -> PatternGains:
    """Return the gain family of a pattern, for one axis, that starts from the gains of the structured LQR.

    It has no delay and no period yet. Raises as `graph_design` does.
    """
    single, narrow, plant = _narrowed(formation, pattern)
    bases = tuple(K for K, _, _ in _base_gains(plant, narrow, single, "graph-lqr"))
    return PatternGains(single, narrow.mask, bases, None, FlownTiming(inf, 0.0))


def _narrowed(formation: FormationModel, pattern: Pattern) -> tuple[FormationModel, Pattern, Plant]:
    """Formation, pattern and plant of one axis; raises if the pattern does not fit or cannot stabilise."""
    single = FormationModel(formation.predecessors, axes=1)
    if pattern.blocks.shape != (single.vehicles, single.vehicles):
        raise BadModelError(
            f"the pattern has {pattern.blocks.shape} blocks; wanted {(single.vehicles, single.vehicles)}"
        )
    narrow = Pattern(pattern.blocks, (1,) * single.vehicles, (1, *(2,) * (single.vehicles - 1)))
    plant = formation_plant(single)
    check_stabilisable(plant, narrow)
    return single, narrow, plant


def _base_gains(
    plant: Plant, pattern: Pattern, single: FormationModel, method: GraphMethod
) -> Iterable[tuple[FloatArray, float | None, SolverFacts | None]]:
    """Base gains for one axis, each with its `cost_loss` and the facts of its solver."""
    if method == "graph-dk":
        found = dk_iteration(plant, pattern)
        yield found.K, None, found.solver
        return
    for ratio in _WEIGHT_RATIOS:
        weight = np.where(single.spacing_mask, ratio, 1.0)
        optimum = structured_lqr(plant, pattern, Weights(np.diag(weight), np.eye(single.inputs)))
        yield optimum.K, optimum.loss, None


def assess(
    formation: FormationModel,
    pattern: Pattern,
    K: FloatArray,
    *,
    period_s: float,
    requirement: Requirement | None = None,
    method: Literal["graph-dk", "graph-lqr", "given"] = "given",
    loss: float | None = None,
    solver: SolverFacts | None = None,
) -> GraphDesign:
    """Return the full report on a gain with a pattern, given for one axis or for all."""
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
        delay_margin_s=sampled_delay_margin(A, B, K, period_s=period_s),
        delay_margin_continuous_s=delay_margin(A, B @ K),
        period_s=period_s,
        vehicles=formation.vehicles,
        certificate=_certificate(closed_loop, decay) if stable else None,
        cost_loss=loss,
        subgraphs=len(partition_by_input(pattern)),
        subgraphs_smallest=len(smallest_partition(pattern)),
        solver=solver,
        requirement=requirement,
        method=method,
    )


def _certificate(closed_loop: FloatArray, decay_rate_1_s: float) -> DecayProof | None:
    """Proof of the largest provable share of the decay rate: P of A_K'P + P A_K + 2 r P = −I; None if there is none."""
    identity = np.eye(len(closed_loop))
    for share in _PROVED_SHARES:
        shifted = closed_loop + share * decay_rate_1_s * identity
        P: FloatArray = np.real(linalg.solve_continuous_lyapunov(shifted.T, -identity)).astype(np.float64)
        try:
            return decay_proof(closed_loop, (P + P.T) / 2.0)
        except SolverError:
            continue
    return None
