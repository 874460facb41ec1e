"""Large blocks: eigenvalues followed along the unit circle against grids, root counts and exact answers."""

from collections.abc import Sequence

import numpy as np
import pytest

from gains.core.arrays import FloatArray
from gains.core.structure import balanced, block_diagonal
from gains.delay._crossings import axis_crossings
from gains.delay._mixed import count_unstable_roots
from gains.delay._tracked import tracked_crossings
from gains.delay.constant import analyse_delay
from gains.delay.rightmost import rightmost_root


def random_loop(n: int, seed: int, *, late: int = 1) -> list[FloatArray]:
    """A_0, ..., A_m of a dense loop that is stable without delay and oscillates with it."""
    rng = np.random.default_rng(seed)
    now = rng.normal(size=(n, n)) / np.sqrt(n) - np.eye(n)
    delayed = [(2.0 * rng.normal(size=(n, n)) / np.sqrt(n) - 2.0 * np.eye(n)) / late for _ in range(late)]
    right = float(np.linalg.eigvals(now + sum(delayed)).real.max())
    return [now - max(0.0, right + 0.2) * np.eye(n), *delayed]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_followed_branches_cross_where_the_pencil_says(seed: int) -> None:
    now, late = balanced(*random_loop(12, seed))
    exact, tracked = axis_crossings(now, late), tracked_crossings([now, late])
    assert len(exact) == len(tracked) > 0
    assert [c.omega_rad_s for c in tracked] == pytest.approx([c.omega_rad_s for c in exact], rel=1e-9)
    assert [c.delay_s for c in tracked] == pytest.approx([c.delay_s for c in exact], rel=1e-9)
    assert [c.direction for c in tracked] == [c.direction for c in exact]


@pytest.mark.parametrize("late", [1, 2])
def test_large_blocks_lose_stability_at_their_margin(late: int) -> None:
    matrices = random_loop(40, 5, late=late)
    margin_s = analyse_delay(*matrices).delay_margin_s
    assert 0.0 < margin_s < np.inf
    # 1e-4 beside the margin the growth is far above what Newton's method leaves
    for factor, stable in ((1.0 - 1e-4, True), (1.0 + 1e-4, False)):
        pairs = [(matrix, k * factor * margin_s) for k, matrix in enumerate(matrices)]
        assert (rightmost_root(pairs).real < 0.0) == stable
        assert (count_unstable_roots(pairs) == 0) == stable


def test_equal_roots_are_counted_each() -> None:
    # x'' of 13 equal oscillators in rotated coordinates: one block, every eigenvalue thirteen times
    basis = np.linalg.qr(np.random.default_rng(1).normal(size=(26, 26)))[0]
    parts: list[FloatArray] = [np.array([[0.0, 1.0], [-2.0, 0.1]]), np.array([[0.0, 0.0], [1.0, 0.0]])]
    now, late = ((basis @ np.kron(np.eye(13), part) @ basis.T).astype(np.float64) for part in parts)
    found = tracked_crossings([now, late])
    assert [crossing.direction for crossing in found] == [-1] * 13 + [1] * 13
    # 13 equal roots are known to the digits that the single one has here
    [window] = analyse_delay(now, late).stable_intervals_s
    assert window == pytest.approx(analyse_delay([[0, 1], [-2, 0.1]], [[0, 0], [1, 0]]).stable_intervals_s[0], rel=1e-9)


def accounted(terms: Sequence[FloatArray]) -> bool:
    """Whether the crossings account for the eigenvalues right of the axis at every angle."""
    found = tracked_crossings(terms)
    # a crossing at (omega, theta) is one at (-omega, -theta): along the upper half circle both ways are met
    turns = [(c.omega_rad_s * c.delay_s % (2.0 * np.pi), c.direction) for c in found]
    met = [(turn, way) if turn <= np.pi else (2.0 * np.pi - turn, -way) for turn, way in turns]
    for theta in np.linspace(0.01, np.pi - 0.01, 150).tolist():
        matrix = np.tensordot(np.exp(-1j * np.arange(len(terms)) * theta), np.array(terms), axes=1)
        right = int(np.count_nonzero(np.linalg.eigvals(matrix).real > 0.0))
        if right != sum(way for turn, way in met if turn < theta):
            return False
    return True


@pytest.mark.parametrize(("n", "seed", "late"), [(40, 3, 1), (40, 4, 2), (70, 5, 1), (30, 6, 4)])
def test_crossings_account_for_the_eigenvalues_right_of_the_axis(n: int, seed: int, late: int) -> None:
    assert accounted(balanced(*random_loop(n, seed, late=late)))


def test_two_close_crossings_that_were_missed_once_are_found() -> None:
    rng = np.random.default_rng()
    stream = {"state": 94799410664117570059276966563265127390, "inc": 317612346296202158696945144441957901887}
    rng.bit_generator.state = {"bit_generator": "PCG64", "state": stream, "has_uint32": 1, "uinteger": 1949737449}
    n = int(rng.integers(25, 41))
    now, late = (rng.standard_normal((n, n)) / np.sqrt(n) - shift * np.eye(n) for shift in (0.6, 2.0))
    assert len(tracked_crossings([now, late])) == 33
    assert accounted([now, late])


@pytest.mark.parametrize("excess", [1e-2, 1e-4, 1e-6, 1e-8])
def test_a_near_tangent_pair_is_found_among_many_states(excess: float) -> None:
    # s^2 + s + 1 + c e^{-s tau} touches the axis at c = sqrt(3/4); beside it 28 states of other speeds, in one block
    c = np.sqrt(0.75) * (1.0 + excess)
    pairs = [([[0.0, 1.0], [-1.0, -1.0]], [[0.0, 0.0], [-c, 0.0]])]
    rng = np.random.default_rng(3)
    pairs += [
        (speed * rng.normal(size=(4, 4)) - 3.0 * speed * np.eye(4), speed * rng.normal(size=(4, 4)))
        for speed in np.geomspace(0.3, 3.0, 7).tolist()
    ]
    expected = sorted(
        (crossing.omega_rad_s, crossing.delay_s, crossing.direction)
        for now, late in pairs
        for crossing in axis_crossings(np.array(now), np.array(late))
    )
    basis = np.linalg.qr(rng.normal(size=(30, 30)))[0]
    now, late = (basis @ matrix @ basis.T for matrix in block_diagonal([[*map(np.array, pair)] for pair in pairs]))
    found = [(c.omega_rad_s, c.delay_s, c.direction) for c in tracked_crossings([now, late])]
    # a pair that is this close together is known to the rounding over its distance, which is sqrt(excess)
    assert len(found) == len(expected) >= 2
    assert np.array(found) == pytest.approx(np.array(expected), rel=1e-12 / np.sqrt(excess))
