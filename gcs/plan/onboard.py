"""Planning with loop "onboard": which feedback the vehicles compute, and which the station streams to them.

u_i(t) = K_ii e_i(t) + sum over j of K_ij e_j(t - tau) (thesis eq. 5.1). The vehicle computes the first term from its
own velocity and its own sensor for the vehicle ahead; its gains are the parameters that `own_parameters` names. The
station computes the second term and sends it as the acceleration of SET_POSITION_TARGET_LOCAL_NED, which autopilots
treat as feed-forward, with the formation's velocity v_d as the velocity.
"""

from dataclasses import asdict, replace

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.requirement import plain
from gains.performance.behaviour import behaviour
from gains.sampled.onboard import onboard_loop, own_part, streamed_loop
from gcs.errors import InputError
from gcs.plan.design import Behaviour, Design, GainSet, OnboardPart
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.formation import Formation

AXES = "NE"
_STILL_1_S = 1e-6
"""Growth rate of own loops that counts as zero. With prediction, their errors may persist but must not grow."""


def onboard_plan(design: Design, plan: FlightPlan) -> tuple[Design, FlightPlan]:
    """Design and plan of the onboard loop, from those of a ground loop with the same gains.

    Own gains are rounded to float32, in which they are uploaded: the analysed gains are those flown. Slower entries of
    the schedule keep the vehicles' own gains and reduce the share of the stream. Without any stream the formation is
    stable at every delay. If vehicles share loops, it flies without a stream while a vehicle is lost.
    """
    timing = plan.onboard
    assert timing is not None
    own = own_part(plan.model, plan.gain).astype(np.float32).astype(np.float64)
    others = plan.gain - own_part(plan.model, plan.gain)
    shares = [1.0 / scale for scale in plan.scenario.monitor.time_scales]
    gains = [own + share * others for share in shares]
    loops = [onboard_loop(plan.model, gain, timing) for gain in gains]
    sampled_s = [loop.sampled_margin_s() for loop in loops]
    if plan.scenario.control.prediction != "off":
        A, _, _ = streamed_loop(plan.model, gains[0], timing)
        if (fastest_1_s := float(np.linalg.eigvals(A).real.max())) > _STILL_1_S:
            raise InputError(
                f"{plan.scenario.name}: control.prediction: read own loops whose errors grow at {fastest_1_s:.3g} 1/s "
                "without the stream, wanted stable ones with loop onboard"
            )
    onboard = OnboardPart(
        rate_hz=plan.scenario.onboard.rate_hz,
        sensor_hz=plan.scenario.onboard.sensor_hz,
        ground_delay_margin_s=design.delay_margin_s,
        ground_delay_margin_continuous_s=design.delay_margin_continuous_s,
    )
    schedule = tuple(
        GainSet(streamed_share=share, delay_margin_s=margin_s, delay_margin_continuous_s=loop.continuous_margin_s())
        for share, margin_s, loop in zip(shares, sampled_s, loops, strict=True)
    )
    flown = replace(
        plan,
        gain=gains[0],
        delay_margin_s=sampled_s[0],
        slower=tuple(zip(gains[1:], sampled_s[1:], strict=True)),
        around_loss=() if plan.separable else (own,) * len(gains),
    )
    if design.inclusion_gains is not None and design.behaviour is not None:  # at the delay used for the ground loop
        own_delay_s = 0.5 / plan.scenario.onboard.rate_hz
        found = behaviour(design.inclusion_gains, design.behaviour.delay_s, own_delay_s=own_delay_s)
        design = design.model_copy(update={"behaviour": Behaviour.model_validate(plain(asdict(found)))})
    return design.with_schedule(schedule, loop="onboard", onboard=onboard), flown


def own_parameters(formation: Formation, K: FloatArray, row: int) -> dict[str, float]:
    """Names and values of the parameters with which a vehicle flies its own loop.

    FORM_AHEAD is the system id of the vehicle ahead, 0 for the leader, and FORM_OFF_N and _E are the wanted position
    relative to it. FORM_KP_xy and FORM_KV_xy are the gains from spacing and velocity error in y to acceleration in x.
    FORM_LOOP, the last, switches the loop on.
    """
    model = formation.model
    ahead = model.predecessors[row]
    rows, north_east = model.input_slice(row), enumerate(formation.offset_ne_m[row].tolist())
    on_spacing = K[rows, model.spacing_slice(row)] if ahead >= 0 else np.zeros((2, 2))
    on_velocity = K[rows, model.velocity_slice(row)]
    return {
        "FORM_AHEAD": float(formation.system_ids[ahead]) if ahead >= 0 else 0.0,
        **{f"FORM_OFF_{AXES[k]}": offset_m for k, offset_m in north_east},
        **{
            f"FORM_{kind}_{AXES[i]}{AXES[j]}": float(block[i, j])
            for kind, block in (("KP", on_spacing), ("KV", on_velocity))
            for i in range(2)
            for j in range(2)
        },
        "FORM_LOOP": 1.0,
    }
