"""The source's nonlinear model of chapter 5, with late information from neighbours: eq. (5.1).

X' = V cos ψ, Y' = V sin ψ, ψ' = ω, V' = a with (a, ω) = M(ξ) u, eqs. (2.2)-(2.6), integrated by RK4 with M in every
stage; u_i(t) = K_ii x_i(t) + sum of K_ij x_j(t − h), held for one step of 1 ms. It shares no code with the vehicles of
the flights.
"""

import numpy as np

from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from gains.sampled.onboard import own_part

STEP_S = 1e-3


def fly_with_late_neighbours(
    formation: FormationModel, K: FloatArray, start: FloatArray, *, delay_s: float, speed_m_s: float, duration_s: float
) -> tuple[FloatArray, FloatArray]:
    """Times (k,) and errors e (k, states) of a formation that starts with errors `start` (states,), heading north.

    Before the start the errors are constant.
    """
    steps, lag = round(duration_s / STEP_S), round(delay_s / STEP_S)
    own = own_part(formation, K)
    others = K - own
    nominal = np.array([speed_m_s, 0.0])
    state = _states(formation, start, nominal)
    errors = np.empty((steps + 1, formation.states))
    errors[0] = start
    for k in range(steps):
        u = own @ errors[k] + others @ errors[max(0, k - lag)]
        state = _rk4(state, u.reshape(-1, 2))
        errors[k + 1] = _errors(formation, state, nominal)
    return np.arange(steps + 1, dtype=np.float64) * STEP_S, errors


def _states(formation: FormationModel, errors: FloatArray, nominal: FloatArray) -> FloatArray:
    """Rows (X, Y, ψ, V) with these errors; the wanted spacing is zero, as it cancels."""
    rows: list[FloatArray] = []
    for i, ahead in enumerate(formation.predecessors):
        velocity = nominal + errors[formation.velocity_slice(i)]
        position = np.zeros(2) if ahead < 0 else rows[ahead][:2] - errors[formation.spacing_slice(i)]
        rows.append(np.array([*position, np.arctan2(velocity[1], velocity[0]), np.hypot(*velocity)]))
    return np.array(rows)


def _errors(formation: FormationModel, state: FloatArray, nominal: FloatArray) -> FloatArray:
    errors = np.empty(formation.states)
    velocity = state[:, 3:] * np.stack([np.cos(state[:, 2]), np.sin(state[:, 2])], axis=1)
    for i, ahead in enumerate(formation.predecessors):
        errors[formation.velocity_slice(i)] = velocity[i] - nominal
        if ahead >= 0:
            errors[formation.spacing_slice(i)] = state[ahead, :2] - state[i, :2]
    return errors


def _rk4(state: FloatArray, u: FloatArray) -> FloatArray:
    k1 = _rates(state, u)
    k2 = _rates(state + 0.5 * STEP_S * k1, u)
    k3 = _rates(state + 0.5 * STEP_S * k2, u)
    k4 = _rates(state + STEP_S * k3, u)
    return state + STEP_S / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def _rates(state: FloatArray, u: FloatArray) -> FloatArray:
    cosine, sine, speed = np.cos(state[:, 2]), np.sin(state[:, 2]), state[:, 3]
    along, across = cosine * u[:, 0] + sine * u[:, 1], cosine * u[:, 1] - sine * u[:, 0]
    return np.stack([speed * cosine, speed * sine, across / speed, along], axis=1)
