"""What a simulated multicopter says of itself: its state to frames."""

import math
from typing import NamedTuple

from sim_vehicles import mavlink
from sim_vehicles.copter_dynamics import Motion
from sim_vehicles.copter_rules import Rules
from sim_vehicles.vehicle import EARTH_RADIUS_M, ORIGIN_ALTITUDE_M, ORIGIN_LATITUDE_DEG, ORIGIN_LONGITUDE_DEG

READY_FLAGS, NOT_READY_FLAGS = 0x33F, 0x481
"""Estimator flags with all that is wanted; and attitude only, constant position mode, uninitialised."""


class Facts(NamedTuple):
    """What the reports say, at one instant. `origin_neu_m` is where its local frame begins, in the scenario's frame."""

    motion: Motion
    origin_neu_m: tuple[float, float, float]
    mode: int
    armed: bool
    landed: bool
    failsafe: bool
    ready: bool
    """It has a position. Without one it sends a global position of zeros and no local one, as ArduPilot does."""


def reportable(rules: Rules) -> tuple[int, ...]:
    """The messages that can be asked for."""
    return (
        mavlink.HEARTBEAT,
        mavlink.LOCAL_POSITION,
        mavlink.GLOBAL_POSITION,
        mavlink.GLOBAL_ORIGIN,
        mavlink.HOME_POSITION,
        rules.estimator_message,
    )


def report(message_id: int, encoder: mavlink.Encoder, rules: Rules, facts: Facts, boot_ms: int) -> bytes | None:
    """The frame of one of the messages, None if there is nothing to say yet."""
    motion, (origin_north_m, origin_east_m, origin_up_m) = facts.motion, facts.origin_neu_m
    if message_id == mavlink.HEARTBEAT:
        return encoder.heartbeat(_base_mode(facts), facts.mode, _status(facts), rules.autopilot)
    if message_id == rules.estimator_message:
        return encoder.estimator_flags(message_id, boot_ms * 1000, READY_FLAGS if facts.ready else NOT_READY_FLAGS)
    if message_id == mavlink.GLOBAL_POSITION:
        return _global_position(encoder, motion, boot_ms, known=facts.ready)
    if not facts.ready:
        return None
    if message_id == mavlink.LOCAL_POSITION:
        north, east = motion.north_m - origin_north_m, motion.east_m - origin_east_m
        down = origin_up_m - motion.altitude_m
        return encoder.local_position(boot_ms, north, east, down, motion[2:4], -motion.climb_m_s)
    assert message_id in (mavlink.GLOBAL_ORIGIN, mavlink.HOME_POSITION)
    origin = encoder.global_origin if message_id == mavlink.GLOBAL_ORIGIN else encoder.home_position
    return origin(*_degrees(origin_north_m, origin_east_m), ORIGIN_ALTITUDE_M + origin_up_m)


def _base_mode(facts: Facts) -> int:
    return mavlink.BASE_MODE_CUSTOM | (mavlink.BASE_MODE_ARMED if facts.armed else 0)


def _status(facts: Facts) -> int:
    if facts.failsafe:
        return mavlink.STATUS_CRITICAL
    return mavlink.STATUS_STANDBY if facts.landed else mavlink.STATUS_ACTIVE


def _global_position(encoder: mavlink.Encoder, motion: Motion, boot_ms: int, *, known: bool) -> bytes:
    latitude, longitude = _degrees(motion.north_m, motion.east_m) if known else (0.0, 0.0)
    return encoder.global_position(
        time_boot_ms=boot_ms,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=ORIGIN_ALTITUDE_M + motion.altitude_m,
        relative_altitude_m=motion.altitude_m,
        velocity_ne_m_s=motion[2:4],
        heading_deg=0.0,
    )


def _degrees(north_m: float, east_m: float) -> tuple[float, float]:
    """Latitude and longitude of a place in the scenario's frame, on a flat earth."""
    east_per_radian_m = EARTH_RADIUS_M * math.cos(math.radians(ORIGIN_LATITUDE_DEG))
    return (
        ORIGIN_LATITUDE_DEG + math.degrees(north_m / EARTH_RADIUS_M),
        ORIGIN_LONGITUDE_DEG + math.degrees(east_m / east_per_radian_m),
    )
