"""Disturbances of vehicles and errors of their reports; `sim_vehicles.motion` implements them."""

from typing import Annotated

from pydantic import Field

from scenarios.keys.part import NotNegative, Number, Part, Positive

AllPass = Annotated[float, Field(gt=-1, le=1)]


class Gusts(Part):
    """First-order gusts: an acceleration north and one east whose correlation falls by e^(-t / correlation_time_s)."""

    deviation_m_s2: Positive
    """Standard deviation on each axis."""
    correlation_time_s: Annotated[float, Field(ge=0.1, le=1e4)]
    """Time after which the correlation has fallen to 1 / e. Gusts change every 10 ms, well within it."""
    common: bool = False
    """True: the same gusts push every vehicle. False: each vehicle has its own."""


class Sector(Part):
    """A disturbance w = D e that depends on the true errors e, computed anew every control period (thesis eq. 3.20).

    e is (velocity error of the leader, then spacing error and velocity error of each other vehicle, those in front
    first), w is added to the derivative of e, and D is the same for north and east. D(z) = norm * out(z) * direction *
    in(z) with all-pass filters (c + 1/z) / (1 + c/z), which shift the phase of each error but keep its amplitude.
    `gcs stress --disturbance` finds the worst D. Only with `dynamics = "double_integrator"` and one nominal velocity.
    """

    norm_1_s: NotNegative
    """Largest ratio of |w| to |e|, m/s and m/s² to m and m/s."""
    direction: Annotated[tuple[tuple[Number, ...], ...], Field(min_length=1)]
    """The matrix, scaled to norm one before use. Row: the error whose derivative is disturbed. Column: the error that
    disturbs it."""
    all_pass_in: tuple[AllPass, ...] = ()
    """c of the filter of each column; 1 leaves an error unchanged. All are 1 if omitted."""
    all_pass_out: tuple[AllPass, ...] = ()
    """c of the filter of each row."""


class Disturbance(Part):
    """Pushes on the vehicles in flight, besides their own acceleration; they do not count towards the limits."""

    wind_ne_m_s2: tuple[Number, Number] = (0.0, 0.0)
    """Steady acceleration of every vehicle, north and east."""
    gusts: Gusts | None = None
    """Gusts on top of the wind."""
    sector: Sector | None = None
    """A disturbance that depends on the formation's errors."""


class Navigation(Part):
    """Errors of the positions and velocities that vehicles report in LOCAL_POSITION_NED, north and east.

    Where the loop is closed on board, the sensor has its own noise (`onboard.position_noise_m`).
    """

    position_noise_m: NotNegative = 0.0
    """Standard deviation of the position's noise, drawn anew for each report."""
    velocity_noise_m_s: NotNegative = 0.0
    """Standard deviation of the velocity's noise."""
    position_bias_m: NotNegative = 0.0
    """Standard deviation of the position's bias, which changes slowly."""
    velocity_bias_m_s: NotNegative = 0.0
    """Standard deviation of the velocity's bias."""
    bias_time_s: Positive = 60.0
    """Correlation time of the biases."""
