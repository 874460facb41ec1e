"""The formation loop of vehicles that respond to a command with a lag, as an autopilot does, and its delay margin.

A vehicle is commanded an acceleration u and the velocity that goes with it, v_s' = u. Its acceleration a follows

    lag a' = u + g (v_s - v) - a,   v' = a,

so a / u = (s + g) / (lag s² + s + g), which is 1 / (lag s + 1) for g = 0. Instead of v_s the state holds the velocity
still owed, d = v_s - v, d' = u - a. With these A, B and u = K e, `gains.delay.constant` and
`gains.sampled.multirate` have the margin: one delay, exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.delay.constant import delay_margin
from gains.formation.model import FormationModel
from gains.sampled.multirate import Timing, multirate_delay_margin


@dataclass(frozen=True)
class Response:
    """The response of one vehicle: `lag_s` > 0 from wanted to real acceleration, velocity gain g >= 0 in 1/s.

    BadModelError if the lag is below 1e-6 s, the gain negative, or either not finite.
    """

    lag_s: float
    velocity_gain_1_s: float

    def __post_init__(self) -> None:
        for name, least in (("lag_s", 1e-6), ("velocity_gain_1_s", 0.0)):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= least):
                raise BadModelError(f"{name} = {value}; wanted a number of at least {least:g}")

    def transfer(self, omega: FloatArray) -> NDArray[np.complex128]:
        """a / u at jω, from wanted to real acceleration: (s + g) / (lag s² + s + g)."""
        s, g = 1j * omega, self.velocity_gain_1_s
        if g == 0.0:  # a root at 0 cancels
            return np.reciprocal(self.lag_s * s + 1.0)
        return (s + g) / (self.lag_s * s**2 + s + g)


def formation_loop(
    model: FormationModel, K: FloatArray, responses: Sequence[Response]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (A, B, K) of the formation u = K e whose vehicles have these responses, one for each in the model's order.

    The state is e of `gains.formation.model`, followed by a and d of each vehicle; a vehicle with g = 0 has no d.
    BadModelError unless K has the shape (inputs, states) of the model and there is one response for each vehicle.

    A leader by itself, of one axis: e' = a, 0.5 a' = u − a, u = −e.

    >>> A, B, K = formation_loop(FormationModel((-1,), axes=1), np.array([[-1.0]]), [Response(0.5, 0.0)])
    >>> (A + B @ K).tolist()
    [[0.0, 1.0], [-2.0, -2.0]]
    """
    if len(responses) != model.vehicles:
        raise BadModelError(f"there are {len(responses)} responses; wanted one for each of {model.vehicles} vehicles")
    if K.shape != (model.inputs, model.states):
        raise BadModelError(f"K has shape {K.shape}; wanted {(model.inputs, model.states)}")
    axes = model.axes
    n = model.states + axes * sum(2 if response.velocity_gain_1_s > 0.0 else 1 for response in responses)
    A, B = np.zeros((n, n)), np.zeros((n, model.inputs))
    A[: model.states, : model.states] = model.A
    identity, at = np.eye(axes), model.states
    for vehicle, response in enumerate(responses):
        rate, gain = 1.0 / response.lag_s, response.velocity_gain_1_s
        own, command = slice(at, at + axes), model.input_slice(vehicle)
        A[model.velocity_slice(vehicle), own] = identity
        A[own, own] = -rate * identity
        B[own, command] = rate * identity
        at += axes
        if gain > 0.0:
            owed = slice(at, at + axes)
            A[own, owed] = gain * rate * identity
            A[owed, own] = -identity
            B[owed, command] = identity
            at += axes
    return A, B, np.hstack([K, np.zeros((model.inputs, n - model.states))])


def sampled_margin(
    model: FormationModel, K: FloatArray, responses: Sequence[Response] | None, *, timing: Timing
) -> float:
    """Return the least loop delay (s) at which the sampled and held loop of these vehicles loses stability.

    Without responses they respond at once. Arguments and exceptions as of `formation_loop` and
    `gains.sampled.multirate.multirate_delay_margin`.

    The leader of `continuous_margin`, sampled: 1.1506 s less half a period or so.

    >>> leader, K = FormationModel((-1,), axes=1), np.array([[-1.0]])
    >>> round(sampled_margin(leader, K, [Response(1.0, 0.0)], timing=Timing(0.02, 0.02)), 3)
    1.141
    """
    loop = (model.A, model.B, K) if responses is None else formation_loop(model, K, responses)
    return float(multirate_delay_margin(*loop, timing))


def continuous_margin(model: FormationModel, K: FloatArray, responses: Sequence[Response]) -> float:
    """Return the least delay (s) at which the continuous loop of these vehicles loses stability.

    Arguments and exceptions as of `formation_loop` and `gains.delay.constant.delay_margin`.

    A leader with s (s + 1) + e^{−sτ} = 0: ω² (1 + ω²) = 1 and τ = (π/2 − atan ω) / ω.

    >>> round(continuous_margin(FormationModel((-1,), axes=1), np.array([[-1.0]]), [Response(1.0, 0.0)]), 4)
    1.1506
    """
    A, B, K_all = formation_loop(model, K, responses)
    return float(delay_margin(A, B @ K_all))
