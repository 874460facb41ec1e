"""The α of the best controller through a delay, by closed forms and a compression computed from samples."""

import numpy as np
import pytest

from gains.core.errors import BadModelError
from gains.criteria.bound import alpha_bound

FOLLOWER = np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])


def is_reached(gamma: float, late_s: float, price: float, steps: int = 400) -> bool:
    """The same test with X from SciPy's Riccati solver and the norm from a matrix of samples."""
    from scipy.linalg import expm, solve_continuous_are

    A, B = FOLLOWER
    entries = np.hstack([B / price, np.eye(2) / gamma])
    X = solve_continuous_are(A, entries, np.eye(2), np.diag([1.0, -1.0, -1.0]))
    drift, F = A + X / gamma**2, B.T @ X / price
    step_s = late_s / steps
    # F e^{drift (i - j) step} between the middles of steps, for i > j, half of it at i = j
    power, rows = np.eye(2), []
    hop = expm(drift * step_s)
    for _ in range(steps):
        rows.append(F @ power * step_s)
        power = hop @ power
    rows[0] = rows[0] / 2
    operator = np.zeros((steps, 2 * steps))
    for i in range(steps):
        for j in range(i + 1):
            operator[i, 2 * j : 2 * j + 2] = rows[i - j]
    return float(np.linalg.norm(operator, 2)) < gamma


def test_bound_is_that_of_a_sampled_compression() -> None:
    late_s, price = 0.31, 0.02
    gamma = 1.0 / alpha_bound(*FOLLOWER, late_s, price=price)
    # 400 samples of the operator resolve a part in a thousand
    assert is_reached(1.003 * gamma, late_s, price)
    assert not is_reached(0.997 * gamma, late_s, price)


def test_price_of_commands_does_not_matter_to_four_digits() -> None:
    assert alpha_bound(*FOLLOWER, 0.31) == pytest.approx(alpha_bound(*FOLLOWER, 0.31, price=1e-5), abs=1e-4)


def test_bound_falls_with_delay_from_one() -> None:
    bounds = [alpha_bound(*FOLLOWER, late_s) for late_s in (0.0, 0.07, 0.31, 1.01)]
    assert bounds[0] == pytest.approx(1.0, abs=1e-6)  # |c| / √(1 + c²) of the source as c grows
    assert bounds[2] == pytest.approx(0.9538, abs=1e-4)
    assert bounds == sorted(bounds, reverse=True)


@pytest.mark.parametrize(("a", "late_s"), [(0.0, 0.05), (0.0, 1e-3), (-50.0, 0.3), (-3.0, 0.3)])
def test_bound_of_one_state_is_the_closed_form(a: float, late_s: float) -> None:
    # without a price the block is cos ωh − (a/ω) sin ωh, with ω² = α² − a²
    omega = np.linspace(1e-3, np.pi, 100_001) / late_s
    block = np.cos(omega * late_s) - a / omega * np.sin(omega * late_s)
    first = omega[np.flatnonzero(block <= 0.0)[0]]
    found = alpha_bound(np.array([[a]]), np.eye(1), late_s)
    assert found == pytest.approx(np.hypot(first, a), rel=1e-3)
    assert alpha_bound(np.array([[a]]), np.eye(1), 0.0) == np.inf


def test_wrong_entries_and_prices_are_refused() -> None:
    for B, price, wanted in [(np.zeros((2, 1)), 1e-4, "rank"), (np.eye(3), 1e-4, "rows"), (np.eye(2), 0.0, "price")]:
        with pytest.raises(BadModelError, match=wanted):
            alpha_bound(FOLLOWER[0], B, 0.3, price=price)
