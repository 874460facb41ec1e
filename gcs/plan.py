"""From a scenario to what is flown: formation, gains, margins."""

from typing import Any

import numpy as np

from gains.design import Design, Requirement, design, evaluate_gains
from gains.formation import FormationModel
from gcs.station import FlightPlan, plan_formation
from scenarios.schema import Scenario


def flight_plan(scenario: Scenario) -> tuple[dict[str, Any], FlightPlan]:
    """The design as plain types (what design.json holds), and the plan to fly it.

    Raises
    ------
    gains.errors.GainsError
        If the scenario's requirement cannot be met.
    """
    formation = plan_formation(scenario)
    model = FormationModel(tuple(formation.predecessor.tolist()))
    found = _design(scenario, model)
    plan = FlightPlan(
        scenario=scenario,
        formation=formation,
        gain=model.overlapping_gain(found.K1, found.K2, found.K3),
        delay_margin_s=found.delay_margin_s,
    )
    return found.to_dict(), plan


def _design(scenario: Scenario, model: FormationModel) -> Design:
    control = scenario.control
    period_s = 1.0 / scenario.rates.control_hz
    if control.gains is not None:
        own, front, spacing = (gain * np.eye(2) for gain in (control.gains.K1, control.gains.K2, control.gains.K3))
        return evaluate_gains(model, own, front, spacing, period_s=period_s)
    requirement = Requirement(
        delay_margin_s=control.delay_margin_s, alpha=control.alpha, string_peak_max=control.string_peak_max
    )
    return design(model, requirement, period_s=period_s)
