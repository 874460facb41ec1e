"""A scenario with the gains that a search found for it, so that they can be written, checked and flown."""

import numpy as np

from gains.core.arrays import FloatArray
from gcs.plan.formation import plan_formation
from scenarios.keys.part import Prediction
from scenarios.schema import Control, FixedGains, GainBlock, Scenario


def with_given(
    scenario: Scenario, *, gains: FixedGains | None = None, blocks: tuple[GainBlock, ...] = (), prediction: Prediction
) -> Scenario:
    """The scenario with gains or blocks given; of its other requirements only the limit on growing errors is kept."""
    old = scenario.control
    control = Control(
        loop=old.loop, string_peak_max=old.string_peak_max, gains=gains, blocks=blocks, prediction=prediction
    )
    vehicles = tuple(vehicle.model_copy(update={"hears": ()}) for vehicle in scenario.vehicles)
    return scenario.model_copy(update={"control": control, "vehicles": vehicles})


def with_gain(scenario: Scenario, K: FloatArray, *, prediction: Prediction) -> Scenario:
    """The same with the gain (inputs, states) of one axis, block by block, for both axes."""
    formation = plan_formation(scenario)
    model, ids, whole = formation.model, formation.system_ids, np.kron(K, np.eye(formation.model.axes))
    blocks = tuple(
        GainBlock(vehicle=ids[i], of=ids[j], gain=(tuple(block[0].tolist()), tuple(block[1].tolist())))
        for i in range(model.vehicles)
        for j in range(model.vehicles)
        if (block := whole[model.input_slice(i), model.output_slice(j)]).any()
    )
    return with_given(scenario, blocks=blocks, prediction=prediction)
