"""The formation loop with vehicles that follow a command late and softly, as an autopilot does, and its delay margin.

A vehicle takes an acceleration u and the velocity v_s that goes with it, v_s' = u. Its acceleration a follows

    lag a' = u + g (v_s - v) - a,   v' = a,

so a / u = (s + g) / (lag s² + s + g), which is 1 / (lag s + 1) for g = 0. In place of v_s the state holds the velocity
still owed, d = v_s - v, d' = u - a. With A, B of this and u = K e the margin is that of `gains.delay` and
`gains.sampled`: one delay, exact. A leader-follower tree is block triangular, so the leader's block and one follower's
of each kind of vehicle decide, see `gains.behaviour`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gains.behaviour import Gains
from gains.delay import delay_margin
from gains.design import Requirement
from gains.errors import BadModelError, InfeasibleError
from gains.sampled import sampled_delay_margin
from gains.search import largest_alpha
from gains.structure import FloatArray

_MARGIN_MAX_S = 30.0
_BISECTIONS = 40
_MARGIN_RESOLUTION = 1e-9


@dataclass(frozen=True)
class Response:
    """How one vehicle answers: `lag_s` > 0 from wanted to real acceleration, velocity gain g >= 0 in 1/s."""

    lag_s: float
    velocity_gain_1_s: float

    def __post_init__(self) -> None:
        for name, least in (("lag_s", 1e-6), ("velocity_gain_1_s", 0.0)):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= least):
                raise BadModelError(f"{name} = {value}; wanted a number of at least {least:g}")


def leader_loop(gains: Gains, response: Response) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(A, B, K) of the leader: state (e^v, a, d), without d if g = 0; u = K1 e^v."""
    own, _, _ = gains
    A, B = _answer(response)
    K = np.zeros((1, len(A)))
    K[0, 0] = 1.0
    return _on_axes(A, own.shape[0]), _on_axes(B, own.shape[0]), np.asarray(np.kron(K, own), dtype=np.float64)


def follower_loop(gains: Gains, response: Response) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(A, B, K) of a follower: state (e^p, e^v, a, d), without d if g = 0; u = K3 e^p + K1 e^v."""
    own, _, spacing = gains
    A_answer, B_answer = _answer(response)
    n = len(A_answer) + 1
    A, B, position, velocity = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((1, n)), np.zeros((1, n))
    A[0, 1] = -1.0
    A[1:, 1:], B[1:] = A_answer, B_answer
    position[0, 0] = velocity[0, 1] = 1.0
    K = np.kron(position, spacing) + np.kron(velocity, own)
    return _on_axes(A, own.shape[0]), _on_axes(B, own.shape[0]), np.asarray(K, dtype=np.float64)


def _on_axes(matrix: FloatArray, axes: int) -> FloatArray:
    return np.asarray(np.kron(matrix, np.eye(axes)), dtype=np.float64)


def _answer(response: Response) -> tuple[FloatArray, FloatArray]:
    """A and B of (v, a, d) for one axis."""
    rate, gain = 1.0 / response.lag_s, response.velocity_gain_1_s
    A = np.array([[0.0, 1.0, 0.0], [0.0, -rate, gain * rate], [0.0, -1.0, 0.0]])
    B = np.array([[0.0], [rate], [1.0]])
    return (A, B) if gain > 0.0 else (A[:2, :2], B[:2])


def sampled_margin(gains: Gains, responses: Sequence[Response], *, period_s: float) -> float:
    """The least delay (s) at which the sampled and held loop of one of the vehicles loses stability."""
    loops = [loop(gains, response) for response in _distinct(responses) for loop in (leader_loop, follower_loop)]
    return float(min(sampled_delay_margin(*loop, period_s=period_s) for loop in loops))


def continuous_margin(gains: Gains, responses: Sequence[Response]) -> float:
    """The same of the continuous loop."""
    loops = [loop(gains, response) for response in _distinct(responses) for loop in (leader_loop, follower_loop)]
    return float(min(delay_margin(A, B @ K) for A, B, K in loops))


def string_peak(gains: Gains, response: Response, *, delay_s: float) -> float:
    """Largest growth of a spacing error from one vehicle to the next, as `gains.behaviour.string_peak`, with response.

    Γ(s) = (s² I - h (s K1 - K3))^{-1} (s K2 + K3) h, h = e^{-sτ} (s + g) / (lag s² + s + g); at least |Γ(0)| = 1.
    """
    own, front, spacing = gains
    fastest = float(np.linalg.norm(own, 2) + np.sqrt(np.linalg.norm(spacing, 2)) + 1.0 / (delay_s + response.lag_s))
    s = 1j * np.geomspace(1e-4 * fastest, 10.0 * fastest, 1000)[:, None, None]
    g = response.velocity_gain_1_s
    h = np.exp(-s * delay_s) * (s + g) / (response.lag_s * s**2 + s + g)
    loop = s**2 * np.eye(own.shape[0]) - h * (s * own - spacing)
    growth = np.linalg.norm(np.linalg.solve(loop, h * (s * front + spacing)), ord=2, axis=(1, 2))
    return max(1.0, float(growth.max()))


def requirement_with(requirement: Requirement, response: Response, *, period_s: float) -> Requirement:
    """The requirement on vehicles that answer at once whose design has the wanted margin with this response.

    The margin with the response grows with the one without it: found by bisection. A requirement without a margin stays
    as it is.

    Raises
    ------
    InfeasibleError
        If no gains have this margin with this response.
    """
    wanted_s = requirement.delay_margin_s
    if wanted_s is None:
        return requirement

    def excess(without_s: float) -> float:
        found = largest_alpha(without_s, period_s, requirement.string_peak_max)
        if found is None:
            return -np.inf
        gains = (-found.k1 * np.eye(1), found.k2 * np.eye(1), found.k3 * np.eye(1))
        return sampled_margin(gains, [response], period_s=period_s) - wanted_s

    low, high = 0.0, wanted_s
    while excess(high) < 0.0:
        low, high = high, 2.0 * high
        if high > _MARGIN_MAX_S:
            raise InfeasibleError(
                f"no gains have a sampled delay margin of {wanted_s} s with lag_s = {response.lag_s} and "
                f"velocity_gain_1_s = {response.velocity_gain_1_s}; ask for less"
            )
    for _ in range(_BISECTIONS):
        if high - low < _MARGIN_RESOLUTION * high:
            break
        middle = (low + high) / 2.0
        low, high = (low, middle) if excess(middle) >= 0.0 else (middle, high)
    return Requirement(delay_margin_s=high, alpha=requirement.alpha, string_peak_max=requirement.string_peak_max)


def _distinct(responses: Sequence[Response]) -> list[Response]:
    if not responses:
        raise BadModelError("there is no response; wanted one for each kind of vehicle")
    return sorted(set(responses), key=lambda response: (response.lag_s, response.velocity_gain_1_s))
