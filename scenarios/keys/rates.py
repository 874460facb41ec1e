"""Rates at which the station and the vehicles send."""

from typing import Annotated

from pydantic import Field

from scenarios.keys.part import Part, Rate


class Rates(Part):
    """Rates of control, telemetry and clock exchanges."""

    control_hz: Rate = 50.0
    """Control ticks of the station; every vehicle is sent one set-point per tick."""
    telemetry_hz: Rate = 50.0
    """LOCAL_POSITION_NED messages from each vehicle."""
    timesync_hz: Annotated[float, Field(ge=0.01, le=50)] = 10.0
    """TIMESYNC exchanges with each vehicle. More than `control_hz` counts as `control_hz`, because each control
    tick logs one round trip."""
    target_hz: Annotated[float, Field(ge=0, le=500)] = 10.0
    """POSITION_TARGET_LOCAL_NED messages from each vehicle, which show which set-point acts; with `control.prediction`
    only, and never more than `telemetry_hz`. 0: none, and every set-point is assumed to act as it was sent."""
