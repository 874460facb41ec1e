"""Conversion from the scenario's frame to latitude and longitude; the earth is taken as flat around the origin."""

import math

from scenarios.kernel import kernel

ORIGIN_LATITUDE_DEG, ORIGIN_LONGITUDE_DEG, ORIGIN_ALTITUDE_M = -35.363262, 149.165237, 584.0
"""Origin of the local frame of all vehicles, on the ground: where ArduPilot's simulator starts."""
EARTH_RADIUS_M = 6_378_137.0
GRAVITY_M_S2 = 9.80665
_EAST_PER_RADIAN_M = EARTH_RADIUS_M * math.cos(math.radians(ORIGIN_LATITUDE_DEG))


@kernel
def degrees(north_m: float, east_m: float) -> tuple[float, float]:
    """Latitude and longitude of a position in the scenario's frame."""
    return (
        ORIGIN_LATITUDE_DEG + math.degrees(north_m / EARTH_RADIUS_M),
        ORIGIN_LONGITUDE_DEG + math.degrees(east_m / _EAST_PER_RADIAN_M),
    )
