"""Reports on a scenario before its flight: places, errors and commands at the start, and the expected loop delay."""

from collections.abc import Iterator
from functools import partial
from math import hypot, inf

import numpy as np
from pydantic import Field

from gains.core.arrays import FloatArray
from gains.core.requirement import plain
from gcs.control.loop_delay import headroom
from gcs.plan.course import PlannedMotion, nearest_planned
from gcs.plan.design import CodeRecord
from gcs.plan.expected_delay import (
    DrawnDelays,
    drawn_delays,
    effective_loop_delays_s,
    planned_loop_delays_s,
    setpoint_gaps,
    waits_for_channels,
)
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.formation import Formation
from gcs.plan.loops import link_delays_left_s
from gcs.plan.mismatch import Tolerated
from gcs.plan.own_law import code_by_key, law_formation
from gcs.preflight.channels import over_channels
from gcs.published import Published
from scenarios.schema import Scenario

_LATE = 0.99


class VehicleCheck(Published):
    """One vehicle at the start."""

    system_id: int
    follows: int | None
    place_ne_m: tuple[float, float]
    """Its place in the formation, relative to the leader."""
    spacing_error_m: float | None
    """None for the leader."""
    command_m_s2: float
    """Magnitude of the first command, before any limit."""
    command_max_m_s2: float | None
    """The largest acceleration that its limits allow at its initial speed; None without a limit."""
    expected_loop_delay_s: float | None
    """None for a leader flown by somebody else, which the station does not command."""
    headroom: float | None
    """Defined as for the formation, at this vehicle's own expected loop delay."""
    link_delay_left_s: float | None
    """How much more delay its link tolerates at the mean phase, if all other links stay as they are. None if unlimited
    or unknown, or if the station predicts over the measured delay, which adapts to the link."""


class PlannedMotionCheck(Published):
    """Extremes of the motion that the course and formation changes require of one vehicle that flies without error."""

    system_id: int
    speed_min_m_s: float
    speed_max_m_s: float
    acceleration_max_m_s2: float
    turn_rate_max_rad_s: float
    beyond: tuple[str, ...]
    """The keys of `limits` that this motion exceeds."""


class CourseCheck(Published):
    """A smooth course: one whose velocity changes take time."""

    duration_s: float
    """When the last waypoint is reached or the last velocity change ends."""
    length_m: float | None
    """Length along the waypoints; None without waypoints."""
    turns: int
    acceleration_max_m_s2: float
    jerk_max_m_s3: float


class ScenarioCheck(Published):
    """A scenario before its flight."""

    expected_loop_delay_s: float
    phase_s: float
    """Half the shorter period of telemetry and control. The phase between the two stays about the same during a flight:
    its loop delay is up to this much longer or shorter than expected, and its links tolerate that much less or more."""
    effective_loop_delay_s: float | None
    """The constant loop delay of equal effect on stability: longer with jitter or losses, because older commands keep
    acting. That of the vehicle left with the least headroom; None if next to nothing arrives."""
    effective_headroom: float | None
    """That vehicle's headroom at that delay."""
    channels_not_included: bool
    """Whether next to nothing reaches a vehicle over a channel of limited bandwidth. Its figures are then without the
    channel, except that its effective loop delay is unknown."""
    channel_use: dict[str, float]
    """By the name of a channel: the time that it needs for all datagrams of a flight, as a share of the flight. Above
    1, it drops datagrams. Of the channels of one name, the fullest counts."""
    outage_s: float | None
    """The longest link outage during the flight, which no figure here includes; None without outages."""
    setpoint_gaps: float
    """Expected number of gaps between set-points, over all vehicles and the whole flight, that exceed
    `safety.setpoint_timeout_s` and so put a vehicle into failsafe. A gap just as long counts as half. Outages are not
    counted."""
    delay_margin_s: float | None
    """None if no delay makes the loop unstable; with prediction, the upper end of the mismatch window."""
    assumed_delay_s: float | None
    """The loop delay that the prediction assumes: the expected one if it is measured. None without prediction."""
    mismatch_window_s: tuple[float, float] | None
    """The shortest and the longest loop delay at which the predicted loop is stable; None without prediction, or if no
    delay is too long."""
    headroom: float | None
    """1 - expected loop delay / margin; with prediction, 1 - mismatch / largest tolerated mismatch of its sign. The
    least of all vehicles; None without a margin."""
    loop_delay_s_p99: float
    """The 99th percentile of the loop delay over the slowest links, at the worst phase of the ticks."""
    headroom_p99: float | None
    """The headroom that 99 % of the set-points keep, for the vehicle with the least; None without a margin."""
    closest_m: float | None
    """Least distance during the flight between the places of two vehicles; None for a single vehicle."""
    closest_s: float | None
    """When the places are that close."""
    course: CourseCheck | None
    """None if the nominal velocity changes in steps."""
    planned: tuple[PlannedMotionCheck, ...]
    """One for each vehicle if the formation manoeuvres."""
    vehicles: tuple[VehicleCheck, ...]
    response_known: bool
    """False for autopilots, which are identified in flight, unless the scenario gives their response. Margins and
    headroom then assume vehicles that respond at once; in flight they are less."""
    response_differs: dict[str, tuple[float | None, float | None]]
    """For each key in which the given `response` differs from the simulated `autopilot`, both values in this order."""
    code: dict[str, CodeRecord] = Field(default_factory=dict[str, CodeRecord])
    """The code that would run: the file by the scenario key that names it."""


def check(plan: FlightPlan) -> ScenarioCheck:
    """Check a plan: its vehicles at the start, and the headroom over the scenario's links."""
    scenario, formation, model = plan.scenario, plan.formation, plan.model
    ordered = scenario.leader_first()
    place = formation.place_ne_m()
    states = np.array([(*vehicle.position_ne_m, *vehicle.velocity_ne_m_s) for vehicle in ordered])
    errors = law_formation(formation, scenario.nominal_velocity_at(0.0), plan.timing.control_s).errors(states)
    commands = plan.gain @ errors
    delays_s, effective_s, drawn, use = _delays(plan)
    limits = scenario.limits
    left_s = link_delays_left_s(plan, effective_s) if scenario.control.prediction != "measured" else dict[int, float]()
    vehicles: list[VehicleCheck] = []
    for row, vehicle in enumerate(ordered):
        north_m, east_m = place[row].tolist()
        turning = (limits.turn_rate_max_rad_s or inf) * hypot(*vehicle.velocity_ne_m_s)
        most = min(limits.acceleration_max_m_s2 or inf, turning)
        at_s = delays_s.get(vehicle.system_id)
        vehicles.append(
            VehicleCheck(
                system_id=vehicle.system_id,
                follows=vehicle.follows,
                place_ne_m=(north_m, east_m),
                spacing_error_m=float(hypot(*errors[model.spacing_slice(row)])) if row else None,
                command_m_s2=float(hypot(*commands[model.input_slice(row)])),
                command_max_m_s2=most if most < inf else None,
                expected_loop_delay_s=at_s,
                headroom=None if at_s is None else plain(_headroom(plan, row, at_s, at_s)),
                link_delay_left_s=plain(left_s.get(vehicle.system_id, inf)),
            )
        )
    delay_s = max(delays_s.values())
    is_predicted = scenario.control.prediction != "off"
    assumed_s = _assumed_s(plan, delay_s)
    tolerated = plan.tolerance(assumed_s)
    shorter_s, margin_s = tolerated.shorter_s[0], tolerated.longer_s[0]
    window_s = max(0.0, assumed_s - shorter_s), assumed_s + margin_s
    left = {own: _headroom(plan, formation.row(own), at_s, delays_s[own]) for own, at_s in effective_s.items()}
    critical = min(left, key=left.__getitem__)
    nearest = nearest_planned(scenario)
    return ScenarioCheck(
        expected_loop_delay_s=delay_s,
        phase_s=_phase_s(scenario),
        effective_loop_delay_s=plain(effective_s[critical]),
        effective_headroom=plain(left[critical]),
        channels_not_included=bool(use) and inf in effective_s.values(),
        channel_use=use,
        outage_s=max(_outages_s(scenario), default=None),
        setpoint_gaps=setpoint_gaps(scenario),
        delay_margin_s=assumed_s + margin_s if margin_s < inf else None,
        assumed_delay_s=assumed_s if is_predicted else None,
        mismatch_window_s=window_s if is_predicted and margin_s < inf else None,
        headroom=min((left for own in vehicles if (left := own.headroom) is not None), default=None),
        loop_delay_s_p99=max(float(np.quantile(own.loop_s, _LATE, axis=1).max()) for own in drawn.values()),
        headroom_p99=_late_headroom(plan, drawn),
        closest_m=None if nearest is None else nearest.distance_m,
        closest_s=None if nearest is None else nearest.time_s,
        course=_course(scenario) if scenario.course.is_smooth else None,
        planned=tuple(_planned(scenario, formation)) if scenario.manoeuvres else (),
        vehicles=tuple(vehicles),
        response_known=plan.response_is_known,
        response_differs=_response_differs(scenario),
        **({"code": code_by_key(scenario)} if scenario.code else {}),
    )


def _delays(plan: FlightPlan) -> tuple[dict[int, float], dict[int, float], dict[int, DrawnDelays], dict[str, float]]:
    """The expected and the effective loop delays (s) of the vehicles, delays at random ticks, and the use of channels.

    They are drawn over the links, or flown where datagrams wait for a channel. A vehicle that no command reaches in
    such a flight has an infinite effective delay; the others are without the channel.
    """
    expected_s, effective_s, drawn = planned_loop_delays_s(plan), effective_loop_delays_s(plan), drawn_delays(plan)
    if not waits_for_channels(plan.scenario):
        return expected_s, effective_s, drawn, {}
    flown = over_channels(plan)
    medians_s = {own: float(np.median(each.loop_s, axis=1).mean()) for own, each in flown.drawn.items()}
    return expected_s | medians_s, effective_s | flown.effective_s, drawn | flown.drawn, flown.use


def _phase_s(scenario: Scenario) -> float:
    return 0.5 / max(scenario.rates.telemetry_hz, scenario.rates.control_hz)


def _assumed_s(plan: FlightPlan, delay_s: float) -> float:
    """The delay over which the station predicts when the loop delay is `delay_s`; 0 without prediction."""
    return delay_s if plan.scenario.control.prediction == "measured" else plan.assumed_s or 0.0


def _headroom(plan: FlightPlan, row: int, delay_s: float, expected_s: float) -> float:
    """A vehicle's headroom at a loop delay, to its margin or, with prediction, to the end of its mismatch window.

    A prediction over the measured delay assumes the expected one, `expected_s`.
    """
    assumed_s = _assumed_s(plan, expected_s)
    tolerated = plan.tolerance_of(row, assumed_s)
    return headroom(tolerated.used_s(0, delay_s - assumed_s), tolerated.longer_s[0])


def _late_headroom(plan: FlightPlan, drawn: dict[int, DrawnDelays]) -> float | None:
    """The headroom that the share `_LATE` of the set-points keep, for the vehicle with the least.

    With prediction the age of a state is known; a mismatch arises only if the set-point acts earlier or later than
    assumed. A measured delay is taken as its mean, which includes the wait for the tick. A given delay assumes the
    average wait, but the actual wait, constant throughout a flight, may be up to half a period shorter or longer.
    """
    prediction, late = plan.scenario.control.prediction, dict[tuple[int, Tolerated], float]()
    wait_s = _phase_s(plan.scenario)
    for system_id, own in drawn.items():
        assumed_s = _assumed_s(plan, float(own.loop_s.mean()))
        tolerated = plan.tolerance_of(plan.formation.row(system_id), assumed_s)
        if (kind := (id(own), tolerated)) not in late:
            mismatch_s = own.loop_s if prediction == "off" else own.down_s + own.ages_s.mean() - assumed_s
            waits_s = (-wait_s, wait_s) if prediction not in {"measured", "off"} else (0.0,)
            late[kind] = min(_kept(mismatch_s + each_s, tolerated) for each_s in waits_s)
    return plain(min(late.values()))


def _kept(mismatch_s: FloatArray, tolerated: Tolerated) -> float:
    """The headroom that the share `_LATE` of these mismatches (phases, k) keep, at the worst phase."""
    used_s = np.vectorize(partial(tolerated.used_s, 0), [float])(mismatch_s)
    return headroom(float(np.quantile(used_s, _LATE, axis=1, method="higher").max()), tolerated.longer_s[0])


def _outages_s(scenario: Scenario) -> Iterator[float]:
    """Durations of all link outages, cut off at the end of the flight."""
    for vehicle in scenario.vehicles:
        for link in scenario.link_of(vehicle.system_id):
            for outage in link.outages:
                if outage.from_s < scenario.duration_s:
                    yield min(outage.until_s, scenario.duration_s) - outage.from_s


def _response_differs(scenario: Scenario) -> dict[str, tuple[float | None, float | None]]:
    own = scenario.simulated_autopilot
    if scenario.response is None or own is None:
        return {}
    both = {key: (value, getattr(own, key)) for key, value in scenario.response.model_dump().items()}
    return {key: (given, simulated) for key, (given, simulated) in both.items() if given != simulated}


def _course(scenario: Scenario) -> CourseCheck:
    course = scenario.smooth_course()
    largest = [change.largest() for change in course.changes if change.duration_s]
    return CourseCheck(
        duration_s=course.end_s,
        length_m=course.end_s * (scenario.course.speed_m_s or 0.0) if scenario.course.waypoints_ne_m else None,
        turns=len(course.changes),
        acceleration_max_m_s2=max((most for most, _ in largest), default=0.0),
        jerk_max_m_s3=max((most for _, most in largest), default=0.0),
    )


def _planned(scenario: Scenario, formation: Formation) -> Iterator[PlannedMotionCheck]:
    motion, limits = PlannedMotion(scenario, formation), scenario.limits
    behind_another = scenario.course.leader == "external"  # whose speed is not known beforehand
    for row, system_id in enumerate(formation.system_ids):
        found = motion.largest(row)
        exceeded = {
            "speed_min_m_s": found.speed_min_m_s < limits.speed_min_m_s and not behind_another,
            "speed_max_m_s": found.speed_max_m_s > (limits.speed_max_m_s or inf),
            "acceleration_max_m_s2": found.acceleration_max_m_s2 > (limits.acceleration_max_m_s2 or inf),
            "turn_rate_max_rad_s": found.turn_rate_max_rad_s > (limits.turn_rate_max_rad_s or inf)
            and not behind_another,
        }
        yield PlannedMotionCheck(
            system_id=system_id, **found._asdict(), beyond=tuple(key for key, is_so in exceeded.items() if is_so)
        )
