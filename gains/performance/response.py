"""The formation loop of vehicles that respond to commands like an autopilot, and its delay margin.

A vehicle is commanded an acceleration u and the corresponding velocity, v_s' = u. Its acceleration a follows the demand
of its velocity loop, w = u + g (v_s - v), with one of three responses h = a / w:

    lag                  lag a'(t) = w(t) - a(t)                     h = 1 / (lag s + 1)
    lag with dead time   lag a'(t) = w(t - T) - a(t)                 h = e^{-sT} / (lag s + 1)
    second order         a'' / omega_n^2 + lag a' = w - a            h = 1 / (s^2 / omega_n^2 + lag s + 1)

so that v' = a and a / u = h (s + g) / (s + g h), which is h for g = 0. Instead of v_s the state holds the velocity
deficit d = v_s - v, d' = u - a. A dead time becomes a rational function of order 4, whose phase is exact to 1e-6 rad up
to an angle of omega T = 1.3; `Response.transfer` models it exactly. With these A, B and u = K e, `gains.delay.constant`
and `gains.sampled.multirate` compute the margin.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import factorial, inf

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import is_number, shown
from gains.delay.constant import delay_margin
from gains.formation.model import FormationModel
from gains.sampled.multirate import Timing, multirate_delay_margin

_ORDER = 4
"""Order of the rational function (Pade) that approximates a dead time."""


@dataclass(frozen=True)
class Response:
    """The response of one vehicle: its `lag_s` > 0 from demanded to real acceleration, and its velocity gain g >= 0.

    BadModelError if the lag or the natural frequency is below 1e-6, the gain or the dead time is negative, any of them
    is not finite, or both a dead time and a natural frequency are given.
    """

    lag_s: float
    """Time constant; for second order, 2 damping / natural frequency, which has the same phase at low frequencies."""
    velocity_gain_1_s: float
    dead_time_s: float = 0.0
    natural_frequency_rad_s: float | None = None
    """Natural frequency of a second-order response; None for the other models."""

    def __post_init__(self) -> None:
        natural = self.natural_frequency_rad_s
        least = {"lag_s": 1e-6, "velocity_gain_1_s": 0.0, "dead_time_s": 0.0}
        for name, bound in (least if natural is None else least | {"natural_frequency_rad_s": 1e-6}).items():
            value = getattr(self, name)
            if not (is_number(value) and bound <= value < inf):
                raise BadModelError(f"{name} = {shown(value)}; wanted a number of at least {bound:g}")
        if natural is not None and self.dead_time_s:
            raise BadModelError(f"dead_time_s = {self.dead_time_s}; wanted 0 with a natural frequency")

    @property
    def model(self) -> str:
        """The name of the model."""
        if self.natural_frequency_rad_s is not None:
            return "second order"
        return "lag with dead time" if self.dead_time_s else "lag"

    @property
    def damping(self) -> float | None:
        """Damping ratio of a second-order response; None for the other models."""
        return None if self.natural_frequency_rad_s is None else self.lag_s * self.natural_frequency_rad_s / 2.0

    def transfer(self, omega: FloatArray) -> ComplexArray:
        """a / u at jω, from commanded to real acceleration: h (s + g) / (s + g h)."""
        s, g = 1j * omega, self.velocity_gain_1_s
        below = self.lag_s * s + 1.0
        if self.natural_frequency_rad_s is not None:
            below = below + (s / self.natural_frequency_rad_s) ** 2
        late = np.exp(-s * self.dead_time_s)
        if g == 0.0:  # a root at 0 cancels
            return late / below
        return late * (s + g) / (below * s + g * late)


def own_dynamics(response: Response) -> tuple[FloatArray, FloatArray]:
    """Return (A, B) of one vehicle on one axis: the state is its acceleration a, internal states, and d if g > 0.

    The input is u.

    A lag of 0.5 s and a gain of 2 1/s give 0.5 a' = u + 2 d - a, d' = u - a:

    >>> [matrix.tolist() for matrix in own_dynamics(Response(0.5, 2.0))]
    [[[-2.0, 4.0], [-1.0, 0.0]], [[2.0], [1.0]]]
    """
    lag_s, g, natural = response.lag_s, response.velocity_gain_1_s, response.natural_frequency_rad_s
    if natural is None:
        own, entry = np.array([[-1.0 / lag_s]]), np.array([[1.0 / lag_s]])
    else:
        own = np.array([[0.0, 1.0], [-(natural**2), -lag_s * natural**2]])
        entry = np.array([[0.0], [natural**2]])
    if response.dead_time_s:
        line, into, out, through = _dead_time()
        m, late = len(own), np.zeros((len(own) + _ORDER, len(own) + _ORDER))
        late[:m, :m], late[:m, m:], late[m:, m:] = own, entry @ out, line / response.dead_time_s
        own, entry = late, np.vstack([through * entry, into / response.dead_time_s])
    if g == 0.0:
        return own, entry
    n = len(own)
    A, B = np.zeros((n + 1, n + 1)), np.vstack([entry, [[1.0]]])
    A[:n, :n], A[:n, n:], A[n, 0] = own, g * entry, -1.0
    return A, B


@cache
def _dead_time() -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """A dead time T as T x' = A x + B w, w_late = C x + D w: the Pade approximation of e^{-sT}, in companion form."""
    n = _ORDER
    c = [factorial(2 * n - k) / (factorial(k) * factorial(n - k)) for k in range(n + 1)]
    below = np.array(c) / c[n]
    above = below * (-1.0) ** np.arange(n + 1)
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -below[:n]
    B = np.zeros((n, 1))
    B[-1] = 1.0
    return A, B, (above[:n] - above[n] * below[:n])[np.newaxis], float(above[n])


def formation_loop(
    model: FormationModel, K: FloatArray, responses: Sequence[Response] | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (A, B, K) of the formation u = K e whose vehicles have these responses, one for each in the model's order.

    Without responses the vehicles respond at once, and A, B and K are those of the model.

    The state is e of `gains.formation.model`, followed by each vehicle's state of `own_dynamics`, axes interleaved.
    BadModelError unless K has the shape (inputs, states) of the model and there is one response for each vehicle.

    A leader alone on one axis, with e' = a, 0.5 a' = u − a, u = −e:

    >>> A, B, K = formation_loop(FormationModel((-1,), axes=1), np.array([[-1.0]]), [Response(0.5, 0.0)])
    >>> (A + B @ K).tolist()
    [[0.0, 1.0], [-2.0, -2.0]]
    """
    if responses is None:
        return model.A, model.B, K
    if len(responses) != model.vehicles:
        raise BadModelError(f"there are {len(responses)} responses; wanted one for each of {model.vehicles} vehicles")
    if K.shape != (model.inputs, model.states):
        raise BadModelError(f"K has shape {K.shape}; wanted {(model.inputs, model.states)}")
    axes = model.axes
    identity = np.eye(axes)
    dynamics = [tuple(np.kron(part, identity) for part in own_dynamics(response)) for response in responses]
    n = model.states + sum(len(own) for own, _ in dynamics)
    A, B = np.zeros((n, n)), np.zeros((n, model.inputs))
    A[: model.states, : model.states] = model.A
    at = model.states
    for vehicle, (own, entry) in enumerate(dynamics):
        rows = slice(at, at + len(own))
        A[model.velocity_slice(vehicle), at : at + axes] = identity
        A[rows, rows] = own
        B[rows, model.input_slice(vehicle)] = entry
        at += len(own)
    return A, B, np.hstack([K, np.zeros((model.inputs, n - model.states))])


def response_states(model: FormationModel, responses: Sequence[Response]) -> list[slice]:
    """The slice of the states of `formation_loop` that belongs to each vehicle's response.

    >>> response_states(FormationModel((-1, 0), axes=1), [Response(0.5, 0.0), Response(0.5, 2.0)])
    [slice(3, 4, None), slice(4, 6, None)]
    """
    sizes = [model.axes * len(own_dynamics(response)[0]) for response in responses]
    ends = model.states + np.cumsum(sizes)
    return [slice(end - size, end) for end, size in zip(ends.tolist(), sizes, strict=True)]


def pushed_states(model: FormationModel, responses: Sequence[Response]) -> FloatArray:
    """Map from external accelerations of the vehicles (inputs,) to the rates of the states of `formation_loop`.

    They act on the velocity errors and on the velocity deficit: v' = a + w and d' = u − a − w.

    >>> pushed_states(FormationModel((-1,), axes=1), [Response(0.5, 2.0)]).tolist()
    [[1.0], [0.0], [-1.0]]
    """
    places = response_states(model, responses)
    pushed = np.zeros((places[-1].stop, model.inputs))
    pushed[: model.states] = model.B
    for vehicle, (place, response) in enumerate(zip(places, responses, strict=True)):
        if response.velocity_gain_1_s:
            pushed[place.stop - model.axes : place.stop, model.input_slice(vehicle)] = -np.eye(model.axes)
    return pushed


def sampled_margin(
    model: FormationModel, K: FloatArray, responses: Sequence[Response] | None, *, timing: Timing
) -> float:
    """Return the least loop delay (s) at which the sampled and held loop of these vehicles loses stability.

    Without responses they respond at once. Arguments and exceptions as for `formation_loop` and
    `gains.sampled.multirate.multirate_delay_margin`.

    Sampled, the leader of `continuous_margin` has a margin of about 1.1506 s less half a period:

    >>> leader, K = FormationModel((-1,), axes=1), np.array([[-1.0]])
    >>> round(sampled_margin(leader, K, [Response(1.0, 0.0)], timing=Timing(0.02, 0.02)), 3)
    1.141
    """
    return multirate_delay_margin(*formation_loop(model, K, responses), timing)


def continuous_margin(model: FormationModel, K: FloatArray, responses: Sequence[Response]) -> float:
    """Return the least delay (s) at which the continuous loop of these vehicles loses stability.

    Arguments and exceptions as for `formation_loop` and `gains.delay.constant.delay_margin`.

    A leader with s (s + 1) + e^{−sτ} = 0 has ω² (1 + ω²) = 1 and τ = (π/2 − atan ω) / ω:

    >>> round(continuous_margin(FormationModel((-1,), axes=1), np.array([[-1.0]]), [Response(1.0, 0.0)]), 4)
    1.1506
    """
    A, B, K_all = formation_loop(model, K, responses)
    return delay_margin(A, B @ K_all)
