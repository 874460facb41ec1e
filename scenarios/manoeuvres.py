"""Contradictions in the course and the formation changes of a scenario."""

import math
from collections.abc import Iterator
from itertools import pairwise

from scenarios.errors import InWords
from scenarios.keys.part import Fault
from scenarios.schema import Scenario
from scenarios.smooth import TooShortError


def contradictions(scenario: Scenario) -> Iterator[Fault]:
    """Faults of the course and of formation changes that no single key shows."""
    yield from _waypoint_contradictions(scenario)
    yield from _course_contradictions(scenario)
    yield from _leader_contradictions(scenario)
    yield from _change_contradictions(scenario)


def _waypoint_contradictions(scenario: Scenario) -> Iterator[Fault]:
    course, limits = scenario.course, scenario.limits
    points = course.waypoints_ne_m
    if not points:
        if not scenario.nominal_velocity:
            yield "nominal_velocity", [], "at least one entry, or course.waypoints_ne_m"
        if course.speed_m_s is not None:
            yield "course.speed_m_s", course.speed_m_s, "no such key without course.waypoints_ne_m"
        return
    if scenario.nominal_velocity:
        read = InWords(f"{len(scenario.nominal_velocity)} entries")
        yield "nominal_velocity", read, "none with course.waypoints_ne_m"
    if len(points) < 2 or any(a == b for a, b in pairwise(points)):
        wanted = "two places or more, each unlike the one before"
        yield "course.waypoints_ne_m", [list(point) for point in points], wanted
    lowest, highest = limits.speed_min_m_s, limits.speed_max_m_s or math.inf
    for key, value in (("speed_m_s", course.speed_m_s), ("acceleration_max_m_s2", course.acceleration_max_m_s2)):
        if value is None:
            yield f"course.{key}", None, "a value for this key, with course.waypoints_ne_m"
    if course.speed_m_s is not None and not lowest <= course.speed_m_s <= highest:
        wanted = f"a speed within the limits, {lowest:g} to {highest:g} m/s"
        yield "course.speed_m_s", course.speed_m_s, wanted


def _course_contradictions(scenario: Scenario) -> Iterator[Fault]:
    course = scenario.course
    if not course.is_smooth:
        for key, value in (("jerk_max_m_s3", course.jerk_max_m_s3), ("offsets", course.offsets)):
            if value not in (None, "fixed"):
                yield f"course.{key}", value, "no such key without course.acceleration_max_m_s2"
        return
    try:
        changes = scenario.smooth_course().changes
    except TooShortError as error:
        wanted = "longer legs, a lower course.speed_m_s, or larger bounds on acceleration and jerk"
        yield "course.waypoints_ne_m", InWords(error), wanted
        return
    for k, (before, after) in enumerate(pairwise(changes), start=2):
        if not course.waypoints_ne_m and after.from_s < before.until_s:
            wanted = f"at least {before.until_s:.3f}, when the change before is over"
            yield f"nominal_velocity[{k}].from_s", after.from_s, wanted
    if course.offsets == "heading" and scenario.control.loop == "onboard":
        yield "course.offsets", course.offsets, "fixed, with loop onboard: vehicles hold the offsets that were uploaded"


def _leader_contradictions(scenario: Scenario) -> Iterator[Fault]:
    if scenario.course.leader != "external":
        return
    key, control = "course.leader", scenario.control
    if control.loop == "onboard" or control.prediction != "off":
        wanted = "station, with loop onboard or with prediction: both need the nominal velocity beforehand"
        yield key, "external", wanted
    if control.method != "inclusion" or control.blocks:
        yield key, "external", "station, with gains on a graph: only inclusion gains are flown behind another's leader"
    if scenario.course.offsets == "heading":
        yield key, "external", "station, with offsets that turn: the course of another's leader is not known beforehand"
    if scenario.dynamics == "autopilot" and scenario.response is None:
        yield key, "external", "station, unless response is given: another's leader takes no part in the identification"
    if len(scenario.vehicles) == 1:
        yield key, "external", "station, with a single vehicle: there would be nothing to fly"


def _change_contradictions(scenario: Scenario) -> Iterator[Fault]:
    followers = {vehicle.system_id for vehicle in scenario.vehicles if vehicle.follows is not None}
    free_s = 0.0
    for k, change in enumerate(scenario.formation_changes):
        key = f"formation_changes[{k}]"
        if scenario.control.loop == "onboard":
            yield key, InWords("a change"), "none with loop onboard: vehicles hold the offsets that were uploaded"
        if change.at_s < free_s:
            yield f"{key}.at_s", change.at_s, f"at least {free_s:g}, when the change before is over"
        free_s = change.at_s + change.duration_s
        seen: set[int] = set()
        for j, changed in enumerate(change.offsets):
            if changed.system_id not in followers - seen:
                yield f"{key}.offsets[{j}].system_id", changed.system_id, "each vehicle that follows another, once"
            if changed.offset_ne_m == (0.0, 0.0) and not scenario.has_altitude_slots:
                yield f"{key}.offsets[{j}].offset_ne_m", changed.offset_ne_m, "an offset other than zero"
            seen.add(changed.system_id)
