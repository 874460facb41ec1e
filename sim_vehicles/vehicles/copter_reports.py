"""The reports of a simulated multicopter."""

import math
from typing import NamedTuple

from sim_vehicles.services import mavlink, messages
from sim_vehicles.services.earth import GRAVITY_M_S2, ORIGIN_ALTITUDE_M, degrees
from sim_vehicles.vehicles.copter_dynamics import Motion
from sim_vehicles.vehicles.copter_rules import Rules

READY_FLAGS, NOT_READY_FLAGS = 0x33F, 0x481
"""Estimator flags when all is well; and with attitude only, constant position mode, uninitialised."""


class Facts(NamedTuple):
    """What the reports say at one instant. `origin_neu_m` is the origin of the local frame in the scenario's frame."""

    motion: Motion
    origin_neu_m: tuple[float, float, float]
    mode: int
    armed: bool
    landed: bool
    failsafe: bool
    home_ne_m: tuple[float, float]
    """Its initial position on the ground, in the scenario's frame."""
    ready: bool
    """Whether it has a position. Without one its global position is zeros and no local one is sent, as in ArduPilot."""


def reported(rules: Rules) -> tuple[int, ...]:
    """The messages that can be requested from it, besides those of every vehicle."""
    return (
        mavlink.LOCAL_POSITION,
        mavlink.GLOBAL_POSITION,
        mavlink.GLOBAL_ORIGIN,
        mavlink.HOME_POSITION,
        rules.estimator_message,
    )


def report(message_id: int, encoder: mavlink.Encoder, rules: Rules, facts: Facts, boot_ms: int) -> bytes | None:
    """The frame of one of its messages; None if there is nothing to send yet."""
    motion, (origin_north_m, origin_east_m, origin_up_m) = facts.motion, facts.origin_neu_m
    if message_id == mavlink.HEARTBEAT:
        return encoder.heartbeat(_base_mode(facts), facts.mode, _status(facts), rules.autopilot)
    if message_id == mavlink.LOCAL_POSITION and facts.ready:
        down_m = origin_up_m - motion.altitude_m
        position = motion.north_m - origin_north_m, motion.east_m - origin_east_m, down_m
        return encoder.local_position(boot_ms, position, (*motion[2:4], -motion.climb_m_s))
    if message_id == rules.estimator_message:
        flags = READY_FLAGS if facts.ready else NOT_READY_FLAGS
        message = messages.estimator_flags(message_id, boot_ms * 1000, flags)
    elif message_id == mavlink.GLOBAL_POSITION or message_id in messages.EXTRA:
        message = messages.report(message_id, _condition(facts, boot_ms))
    elif message_id == mavlink.GLOBAL_ORIGIN and facts.ready:
        message = messages.global_origin(degrees(origin_north_m, origin_east_m), ORIGIN_ALTITUDE_M + origin_up_m)
    elif message_id == mavlink.HOME_POSITION and facts.ready:
        north, east = facts.home_ne_m
        local = north - origin_north_m, east - origin_east_m, origin_up_m
        message = messages.home_position(degrees(north, east), local)
    else:
        return None
    return encoder.pack(message)


def _base_mode(facts: Facts) -> int:
    return mavlink.BASE_MODE_CUSTOM | (mavlink.BASE_MODE_ARMED if facts.armed else 0)


def _status(facts: Facts) -> int:
    if facts.failsafe:
        return mavlink.STATUS_CRITICAL
    return mavlink.STATUS_STANDBY if facts.landed else mavlink.STATUS_ACTIVE


def _condition(facts: Facts, boot_ms: int) -> messages.Condition:
    """What it reports to other ground stations; it tilts to accelerate."""
    motion = facts.motion
    cosine, sine = math.cos(motion.yaw_rad), math.sin(motion.yaw_rad)
    north, east = motion.acceleration_north_m_s2 / GRAVITY_M_S2, motion.acceleration_east_m_s2 / GRAVITY_M_S2
    roll_rad, pitch_rad = math.atan(cosine * east - sine * north), -math.atan(cosine * north + sine * east)
    return messages.Condition(
        boot_ms,
        degrees(motion.north_m, motion.east_m),
        ORIGIN_ALTITUDE_M + motion.altitude_m,
        (*motion[2:4], -motion.climb_m_s),
        (roll_rad, pitch_rad, motion.yaw_rad),
        flying=not facts.landed,
        has_position=facts.ready,
    )
