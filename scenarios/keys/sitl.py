"""The clock errors that simulated copters share with autopilots in SITL."""

from typing import Annotated

from pydantic import Field

from scenarios.keys.part import Part


class Sitl(Part):
    """The clocks of vehicles that run in SITL. Everything is drawn from the seed, for each vehicle on its own."""

    timesync_back_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Largest time by which the stamps in TIMESYNC replies are too early; that of each reply is uniform from 0. An
    ArduPilot dates them back by the time of their bytes on a serial port: up to 0.0035 at its default baud rate."""
    slip_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Mean time by which the boot clock falls behind whenever the simulator cannot keep up; exponential."""
    slip_every_s: Annotated[float, Field(gt=0, le=86400)] = 20.0
    """Mean time between two such slips; exponential. Only with `slip_s`."""
