"""The spread of spacing errors that a scenario's gusts, wind and navigation errors cause at a loop delay.

The spread is exact for a station that closes every loop at one rate (`gains.performance.disturbed`), with the fastest
gains and links of one constant delay. If clocks differ, the station interpolates the state of the vehicle in front
between two reports, which averages white noise. The amount is known only after the flight. Before it, all vehicles are
assumed to sample at the same time, and the errors reported in flight may be up to 13 % smaller. The spread is not
computed for the loop on board, nor for a disturbance that depends on the errors (a sector).
"""

from dataclasses import replace

import numpy as np

from gains.core.arrays import FloatArray
from gains.criteria.predicted import fed_forward
from gains.formation.model import FormationModel
from gains.performance.disturbed import DisturbedFormation, Gusts, Sensing
from gains.performance.radii import SectorLoop
from gains.performance.response import formation_loop, pushed_states
from gains.performance.robust import disturbance_bound
from gcs.plan.design import Design, PredictedSpread, VehicleSpread, WholeFigures
from gcs.plan.expected_delay import expected_loop_delay_s
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.formation import Formation, plan_formation
from scenarios.schema import Scenario

_MOST_WHOLE = 50
"""Largest formation whose α is computed: the work grows with the fourth power of the size; 100 vehicles take 40 s."""


def with_spread(design: Design, plan: FlightPlan) -> Design:
    """The design with the spread expected at the loop delay of the scenario's links, and α of the whole formation."""
    scenario = plan.scenario
    delay_s = expected_loop_delay_s(scenario)
    spread = predicted_spread(design, scenario, delay_s)
    return design.model_copy(update={"spread": spread, "whole": _whole(design, plan, delay_s)})


def predicted_spread(
    design: Design, scenario: Scenario, delay_s: float | FloatArray | None, older: FloatArray | None = None
) -> PredictedSpread | None:
    """The rms of each follower's spacing error; None if nothing disturbs the formation, or if the rms is unknown.

    `delay_s` and `older` are those of `gains.performance.disturbed.DisturbedFormation`.
    """
    formation = plan_formation(scenario)
    flown = (
        None if delay_s is None or design.margin_unknown else disturbed_formation(design, scenario, formation, delay_s)
    )
    if flown is None or delay_s is None or not (decay_1_s := flown.decay_1_s()) > 0.0:
        return None
    spread, model = replace(flown, older=older).spread(), formation.model

    def rms_m(deviation: FloatArray, vehicle: int) -> float:
        own = model.spacing_slice(vehicle)
        return float(np.sqrt((deviation[own] ** 2 + spread.mean[own] ** 2).sum()))

    return PredictedSpread(
        loop_delay_s=float(np.max(delay_s)),
        decay_rate_1_s=decay_1_s,
        vehicles=tuple(
            VehicleSpread(
                system_id=formation.system_ids[i],
                spacing_error_rms_m=rms_m(spread.true, i),
                reported_rms_m=rms_m(spread.reported, i),
            )
            for i in model.followers
        ),
    )


def disturbed_formation(
    design: Design, scenario: Scenario, formation: Formation, delay_s: float | FloatArray
) -> DisturbedFormation | None:
    """The loop of a design and its disturbances, at one loop delay (s) for all vehicles or one for each."""
    air, navigation, rates, control = scenario.disturbance, scenario.navigation, scenario.rates, scenario.control
    K = _gain(design, formation.model)
    if (air is None and navigation is None) or K is None or design.onboard is not None:
        return None
    if (air is not None and air.sector is not None) or rates.control_hz != rates.telemetry_hz:
        return None
    loop, pushed = (formation.model.A, formation.model.B, K), None
    if design.response is not None:
        if not (known := design.responses):
            return None
        every = [known[system_id] for system_id in formation.system_ids]
        loop, pushed = formation_loop(formation.model, K, every), pushed_states(formation.model, every)
    slowest_s = float(np.max(delay_s))
    assumed_s = slowest_s if control.prediction == "measured" else control.prediction
    gusts = None if air is None else air.gusts
    return DisturbedFormation(
        formation.model,
        *loop,
        period_s=1.0 / rates.control_hz,
        delay_s=delay_s if isinstance(assumed_s, str) else slowest_s,
        gusts=None if gusts is None else Gusts(gusts.deviation_m_s2, gusts.correlation_time_s, gusts.common),
        sensing=Sensing() if navigation is None else Sensing(**navigation.model_dump()),
        wind_m_s2=None if air is None else np.array(air.wind_ne_m_s2),
        assumed_s=None if isinstance(assumed_s, str) else assumed_s,
        pushed=pushed,
    )


def _gain(design: Design, model: FormationModel) -> FloatArray | None:
    """K of u = K e; None if the design does not hold it."""
    if design.inclusion_gains is not None:
        return fed_forward(model, model.overlapping_gain(*design.inclusion_gains), design.feed_forward)
    return None if design.K is None else np.array(design.K)


def _whole(design: Design, plan: FlightPlan, delay_s: float) -> WholeFigures | None:
    """α of the whole formation, where the design's own α is that of one follower; None for a large formation."""
    if (
        design.margin_unknown
        or design.inclusion_gains is None
        or not 2 <= design.vehicles <= _MOST_WHOLE
        or design.onboard is not None
        or design.response is not None
    ):
        return None
    model, one = plan.model.narrowed(plan.gain)
    if model.axes > 1:
        return None
    flown = DisturbedFormation(model, model.A, model.B, one, plan.timing.held_s, delay_s, assumed_s=plan.assumed_s)
    stable = flown.decay_1_s() > 0.0
    loop = SectorLoop(flown, tuple(range(model.states)))
    return WholeFigures(
        alpha=disturbance_bound(model.A + model.B @ one, np.eye(model.states)),
        loop_delay_s=delay_s,
        alpha_at_loop_delay=loop.complex_radius().radius_1_s if stable else 0.0,
    )
