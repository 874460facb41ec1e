"""Puts gains from a search or a user into a scenario, which can then be written, checked and flown."""

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import RealArray
from gains.core.structure import real_matrix
from gcs.errors import InputError
from gcs.plan.formation import Formation, plan_formation
from scenarios.keys.part import Prediction
from scenarios.schema import Control, FixedGains, GainBlock, Scenario


def with_given(
    scenario: Scenario, *, gains: FixedGains | None = None, blocks: tuple[GainBlock, ...] = (), prediction: Prediction
) -> Scenario:
    """The scenario with given gains or blocks; of its requirements, only the limit on growing errors is kept."""
    old = scenario.control
    kept = {"loop": old.loop, "string_peak_max": old.string_peak_max, "execute_at": old.execute_at}
    control = Control.model_validate({**kept, "gains": gains, "blocks": blocks, "prediction": prediction})
    vehicles = tuple(vehicle.model_copy(update={"hears": ()}) for vehicle in scenario.vehicles)
    return scenario.model_copy(update={"control": control, "vehicles": vehicles})


def with_gain(scenario: Scenario, K: ArrayLike, *, prediction: Prediction = "off") -> Scenario:
    """The scenario with a given K of u = +K e, the same for north and east; requirements as in `with_given`.

    K has a row for each vehicle and a column for each error of one axis, in the order of
    `gains.FormationModel(..., axes=1)`: the leader's velocity error, then for each follower its spacing error and its
    velocity error. `gains.design` finds such a K; an LQR for A and B of this model finds -K, as its law is u = -K e.
    Raises InputError if K has another shape, and BadModelError if it is not a matrix of finite numbers.
    """
    formation = plan_formation(scenario)
    model, gain = formation.model, real_matrix("K", K)
    wanted = model.B.shape[1] // model.axes, model.B.shape[0] // model.axes
    if gain.shape != wanted:
        raise InputError(
            f"K: read shape {gain.shape}, wanted {wanted}: a row for each vehicle, a column for each error"
        )
    both_axes = np.kron(gain, np.eye(model.axes)).astype(np.float64)
    return with_given(scenario, blocks=gain_blocks(both_axes, formation), prediction=prediction)


def gain_blocks(
    K: RealArray, formation: Formation, links: Sequence[tuple[int, int]] | None = None
) -> tuple[GainBlock, ...]:
    """K as the blocks of a scenario: one for each of `links` or, if None, each vehicle's own and all nonzero ones."""
    model, ids = formation.model, formation.system_ids
    return tuple(
        GainBlock(vehicle=ids[i], of=ids[j], gain=(tuple(block[0].tolist()), tuple(block[1].tolist())))
        for i, j in links or product(range(model.vehicles), repeat=2)
        if (block := K[model.input_slice(i), model.output_slice(j)]).any() or i == j or links
    )
