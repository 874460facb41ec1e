"""The cost of a design as the formation grows: time and free gains, by all routes and by centralised methods."""

import time  # noqa: TID251 - run time is what is measured; nothing flown depends on it
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import numpy as np

from gains.core.requirement import Requirement
from gains.design.design import design
from gains.design.dk_iteration import LARGEST_STATES
from gains.design.graph import GraphMethod
from gains.design.lqr import Weights, centralised_lqr
from gains.design.robust_lmi import centralised_lmi
from gains.formation.model import FormationModel
from gains.formation.pattern import bidirectional, formation_plant, leader_follower
from gains.sampled.constant import forget_margins

RATIO = "times inclusion of 5"
_REFERENCE = ("inclusion", 5)
_SIZES = (3, 5, 10, 20, 40, 80, 200)
_LONGEST_S = 10.0
"""A method is not tried on a size that would take longer than this if its time grows with the cube of the size."""
_DK_STATES = LARGEST_STATES // 2
_REPEATED_BELOW_S = 1.0
_REPEATS = 5
_PERIOD_S = 0.02
_WANTED = Requirement(delay_margin_s=0.3)
_GAIN_BOUND = 30.0
"""Bound of both matrices of the centralised LMI."""


@dataclass(frozen=True)
class DesignCost:
    """The cost of a design for a chain of vehicles: its time, and the number of free gains per axis."""

    method: str
    vehicles: int
    design_s: float
    free_gains: int


def design_costs(ended: Callable[[int], None] = lambda _: None) -> list[DesignCost]:
    """Costs of designs for chains of growing length; times of quick designs are medians of several.

    The decentralised routes meet a sampled margin of 0.3 s at 50 Hz and certify it. The centralised designs need not
    meet a margin: the LQR solves one Riccati equation, the LMI one semidefinite programme. `ended` is called after each
    method with the number left.
    """
    found: list[DesignCost] = []
    _inclusion(3)  # imports at first use are not part of a design
    for left, label in zip(reversed(range(len(_METHODS))), _METHODS, strict=True):
        for vehicles, following in zip(_SIZES, (*_SIZES[1:], _SIZES[-1]), strict=True):
            if _too_large(label, vehicles):
                break
            taken_s, free = timed(label, vehicles)
            found.append(DesignCost(label, vehicles, taken_s, free))
            if taken_s * (following / vehicles) ** 3 > _LONGEST_S:
                break
        ended(left)
    return found


def ratios(costs: list[DesignCost]) -> list[float]:
    """Time of each design over that of inclusion for five vehicles in the same run; empty without designs."""
    reference_s = [cost.design_s for cost in costs if (cost.method, cost.vehicles) == _REFERENCE]
    return [cost.design_s / reference_s[0] for cost in costs]


def left_out(costs: list[DesignCost]) -> list[str]:
    """One line for each method that was not tried on all sizes, with the first size left out and the reason."""
    lines: list[str] = []
    for method, largest in {cost.method: cost.vehicles for cost in costs}.items():
        if (count := _SIZES.index(largest) + 1) < len(_SIZES):
            states = f"more than {_DK_STATES} states an axis"
            why = states if _too_large(method, _SIZES[count]) else f"it may take over {_LONGEST_S:g} s"
            lines.append(f"{method}: not tried on {_SIZES[count]} vehicles and more; {why}")
    return lines


def _too_large(method: str, vehicles: int) -> bool:
    return method == "graph-dk" and 2 * vehicles - 1 > _DK_STATES


def timed(method: str, vehicles: int) -> tuple[float, int]:
    """The time (s) of a design for a chain by a method of `design_costs`, and its free gains per axis."""
    taken_s: list[float] = []
    while True:
        forget_margins()
        begun_s = time.perf_counter()
        free = _METHODS[method](vehicles)
        taken_s.append(time.perf_counter() - begun_s)
        if len(taken_s) == _REPEATS or taken_s[0] > _REPEATED_BELOW_S:
            return median(taken_s), free


def _chain(vehicles: int, axes: int = 2) -> FormationModel:
    return FormationModel(tuple(range(-1, vehicles - 1)), axes=axes)


def _inclusion(vehicles: int) -> int:
    design(_chain(vehicles), _WANTED, period_s=_PERIOD_S)
    return 3


def _graph(vehicles: int, method: GraphMethod, *, two_way: bool) -> int:
    chain = _chain(vehicles)
    pattern = bidirectional(chain) if two_way else leader_follower(chain)
    design(chain, _WANTED, method=method, pattern=pattern, period_s=_PERIOD_S)
    return int(pattern.mask.sum()) // chain.axes**2


def _centralised_lqr(vehicles: int) -> int:
    plant = formation_plant(_chain(vehicles))
    K, _ = centralised_lqr(plant, Weights(np.eye(plant.states), np.eye(plant.B.shape[1])))
    return K.size // 4


def _centralised_lmi(vehicles: int) -> int:
    # one axis: the two axes are independent, and both together would have four times the unknowns for the same gains
    plant = formation_plant(_chain(vehicles, axes=1))
    return centralised_lmi(plant, gain_bound=_GAIN_BOUND, lyapunov_bound=_GAIN_BOUND).K.size


_METHODS: dict[str, Callable[[int], int]] = {
    "inclusion": _inclusion,
    "graph-lqr": lambda vehicles: _graph(vehicles, "graph-lqr", two_way=False),
    "graph-lqr, bidirectional": lambda vehicles: _graph(vehicles, "graph-lqr", two_way=True),
    "graph-dk": lambda vehicles: _graph(vehicles, "graph-dk", two_way=False),
    "centralised LQR": _centralised_lqr,
    "centralised LMI": _centralised_lmi,
}
