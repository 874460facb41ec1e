"""How vehicles with autopilots respond to set-points, and the clock errors of simulated ones, as in SITL."""

from typing import Annotated

from pydantic import Field

from scenarios.keys.part import NotNegative, Part, Positive

DeadTime = Annotated[float, Field(ge=0, le=1)]


class Response(Part):
    """How every vehicle responds to set-points. The control is designed for it.

    A vehicle's velocity loop demands the acceleration w = a_set + gain (v_set - v); its acceleration a follows w by one
    of three models. The station sends v_set' = a_set. Without this part, model and values are identified in a manoeuvre
    before the formation flight.

    lag                 lag a'(t) = w(t) - a(t)
    lag with dead time  lag a'(t) = w(t - dead time) - a(t)
    second order        a'' / natural frequency² + lag a' = w - a
    """

    lag_s: Positive
    """Time constant from demanded to actual acceleration; with a natural frequency, 2 damping / natural frequency."""
    velocity_gain_1_s: NotNegative = 0.0
    """Gain from velocity error to acceleration."""
    dead_time_s: DeadTime = 0.0
    """Dead time before the lag."""
    natural_frequency_rad_s: Positive | None = None
    """Natural frequency; selects the second-order model."""


class Sitl(Part):
    """Clock errors of vehicles that run in SITL, drawn from the seed for each vehicle separately."""

    timesync_back_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Largest time by which the stamps in TIMESYNC replies are too early; drawn uniformly from 0 for each reply.
    ArduPilot backdates them by the time their bytes take on a serial port: up to 0.0035 at its default baud rate."""
    slip_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Mean time by which the boot clock falls behind whenever the simulator cannot keep up; exponential."""
    slip_every_s: Annotated[float, Field(gt=0, le=86400)] = 20.0
    """Mean time between two such slips; exponential. Only with `slip_s`."""
