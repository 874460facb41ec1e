"""Prediction over the loop delay: mismatch windows by the lifted spectrum, by crossings, and by simulated flight."""

from math import inf

import numpy as np
import pytest
from scipy.linalg import expm

from gains import BadModelError, FormationModel, Response, Timing, mismatch_window, rightmost_root
from gains.core.arrays import FloatArray
from gains.core.structure import distinct_blocks
from gains.delay._crossings import DelayedTerm
from gains.delay._mixed import analyse_mixed_block
from gains.delay._windows import combined_analysis
from gains.performance.response import formation_loop
from gains.sampled._loop import HeldPlant, held_blocks
from gains.sampled.multirate import Predictor, lifted_radius
from gains.sampled.prediction import mismatch_window_continuous, predicted_growth_rate

Loop = tuple[FloatArray, FloatArray, FloatArray]

# the gains of triangle5, and its period
K1, K3, PERIOD_S = 3.408, 5.608, 0.02
RATES = Timing(PERIOD_S, PERIOD_S)


def follower(k1: float = K1, k3: float = K3, *, lag_s: float = 0.0) -> Loop:
    """e^p' = -e^v, e^v' = u, or with a lag e^v' = a, lag a' = u - a; u = k3 e^p - k1 e^v."""
    if lag_s == 0.0:
        return np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[k3, -k1]])
    A = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / lag_s]])
    return A, np.array([[0.0], [0.0], [1.0 / lag_s]]), np.array([[k3, -k1, 0.0]])


def lifted(loop: Loop, period_s: float, delay_s: float, assumed_s: float) -> FloatArray:
    """The lifted map as its definition has it, with SciPy's exponential and integrals by Van Loan's block matrix."""
    A, B, K = loop
    n, inputs = B.shape

    def held(duration_s: float) -> tuple[FloatArray, FloatArray]:
        both = np.asarray(expm(np.block([[A, B], [np.zeros((inputs, n + inputs))]]) * duration_s), dtype=np.float64)
        return both[:n, :n], both[:n, n:]

    whole = int(np.floor(delay_s / period_s + 1e-9))
    kept = max(whole, int(np.floor(assumed_s / period_s + 1e-9))) + 1
    Phi, G = held(period_s)
    newer = held(period_s - max(delay_s - whole * period_s, 0.0))[1]
    command = np.zeros((inputs, n + kept * inputs))
    command[:, :n] = K @ held(assumed_s)[0]
    for j in range(1, kept + 1):
        begin_s, end_s = max(0.0, assumed_s - j * period_s), min(assumed_s, assumed_s - (j - 1) * period_s)
        if end_s > begin_s:
            place = slice(n + (j - 1) * inputs, n + j * inputs)
            command[:, place] = K @ (held(assumed_s - begin_s)[1] - held(assumed_s - end_s)[1])
    step = np.zeros((n + kept * inputs, n + kept * inputs))
    step[:n, :n] = Phi
    for age, entry in ((whole, newer), (whole + 1, G - newer)):
        if age == 0:
            step[:n] += entry @ command
        elif age <= kept:
            step[:n, n + (age - 1) * inputs : n + age * inputs] += entry
    step[n : n + inputs] = command
    step[n + inputs :, n:-inputs] += np.eye((kept - 1) * inputs)
    return step


def radius(loop: Loop, period_s: float, delay_s: float, assumed_s: float) -> float:
    return float(np.abs(np.linalg.eigvals(lifted(loop, period_s, delay_s, assumed_s))).max())


def believed_radius(loop: Loop, believed: Loop) -> float:
    """Spectral radius at 1.5 s, true and assumed, where the station predicts another loop than the true one."""
    true, other = (HeldPlant(*matrices, RATES.common_s) for matrices in (loop, believed))
    return lifted_radius(true, RATES, delay_s=1.5, predictor=Predictor(other, 1.5))


def flown_growth(
    model: FormationModel,
    K: FloatArray,
    *,
    delays_s: list[float],
    assumed_s: list[float],
    telemetry_s: float = PERIOD_S,
    duration_s: float,
) -> float:
    """Growth rate (1/s) of a flight of double integrators of one axis, event by event: no matrix of the loop.

    Each vehicle's position and velocity are integrated in closed form between the instants at which its commands act.
    The station predicts each vehicle from its newest sample under the commands sent to it, up to the instant at which
    the new command to vehicle i, delayed by `assumed_s[i]`, acts.
    """
    rng = np.random.default_rng(3)
    vehicles, ticks = model.vehicles, round(duration_s / PERIOD_S)
    position, velocity = rng.standard_normal(vehicles), rng.standard_normal(vehicles)
    sent: list[list[float]] = [[] for _ in range(vehicles)]

    def moved(i: int, start_s: float, state: tuple[float, float], end_s: float, delay_s: float) -> tuple[float, float]:
        """Position and velocity at `end_s` under the commands sent, each acting `delay_s` after its tick."""
        at_s, (p, v) = start_s, state
        k = int(np.floor((start_s - delay_s) / PERIOD_S + 1e-9))
        while at_s < end_s - 1e-12:
            next_s = min(end_s, (k + 1) * PERIOD_S + delay_s)
            u = sent[i][min(k, len(sent[i]) - 1)] if k >= 0 and sent[i] else 0.0
            dt = next_s - at_s
            p, v, at_s, k = p + v * dt + u * dt * dt / 2.0, v + u * dt, next_s, k + 1
        return p, v

    sizes: list[float] = []
    sample, sampled_s, every = [(float(p), float(v)) for p, v in zip(position, velocity, strict=True)], 0.0, 0
    states = list(sample)
    for tick in range(ticks):
        now_s = tick * PERIOD_S
        states = [moved(i, max(now_s - PERIOD_S, 0.0), states[i], now_s, delays_s[i]) for i in range(vehicles)]
        if now_s >= every * telemetry_s - 1e-9:
            sample, sampled_s, every = list(states), now_s, every + 1
        sizes.append(max(abs(v) for _, v in states))
        commands: list[float] = []
        for i in range(vehicles):
            acts_s = now_s + assumed_s[i]
            seen = [moved(j, sampled_s, sample[j], acts_s, assumed_s[j]) for j in range(vehicles)]
            errors = np.zeros(model.states)
            for j in range(vehicles):
                errors[model.velocity_slice(j)] = seen[j][1]
                if j > 0:
                    errors[model.spacing_slice(j)] = seen[model.predecessors[j]][0] - seen[j][0]
            commands.append(float((K @ errors)[i]))
        for i, command in enumerate(commands):
            sent[i].append(command)
    window = round(len(sizes) / 3)
    return float(np.log(max(sizes[-window:]) / max(sizes[window : 2 * window]))) / (window * PERIOD_S)


@pytest.mark.parametrize(
    ("assumed_s", "longer_ms", "shorter_ms", "longer_continuous_ms", "shorter_continuous_ms"),
    [(0.3, 242, None, 248, None), (0.6, 156, 149, 164, 155), (1.5, 83, 83, 87, 87), (3.0, 48, 48, 50, 50)],
)
def test_windows_are_those_of_the_published_table(
    assumed_s: float,
    longer_ms: int,
    shorter_ms: int | None,
    longer_continuous_ms: int,
    shorter_continuous_ms: int | None,
) -> None:
    # sampled figures of the table are whole milliseconds at which the loop is still stable: rounded down
    for window_s, longer, shorter, printed in (
        (mismatch_window(*follower(), RATES, assumed_s=assumed_s), longer_ms, shorter_ms, np.floor),
        (
            mismatch_window_continuous(*follower(), assumed_s=assumed_s),
            longer_continuous_ms,
            shorter_continuous_ms,
            round,
        ),
    ):
        assert printed(1e3 * (window_s[1] - assumed_s)) == longer
        assert window_s[0] == 0.0 if shorter is None else printed(1e3 * (assumed_s - window_s[0])) == shorter
    # without mismatch the decay is that without delay, whatever is assumed
    assert predicted_growth_rate(*follower(), RATES, assumed_s=assumed_s, delay_s=assumed_s) == pytest.approx(
        -1.735, abs=5e-4
    )


POSITION_AND_VELOCITY = [True, True, False]


@pytest.mark.parametrize(
    "rates", [RATES, Timing(0.02, 0.1), Timing(0.02, 0.05), Timing(0.05, 0.02), Timing(1.0 / 200.0, 1.0 / 30.0)]
)
def test_a_computed_lag_has_the_window_of_its_lifted_map(rates: Timing) -> None:
    """No telemetry holds an acceleration. The lifted map shares no algebra with the crossings."""
    loop, seen = follower(lag_s=0.15), POSITION_AND_VELOCITY
    window_s = mismatch_window(*loop, rates, assumed_s=0.613, measured=seen)
    for end_s, way in zip(window_s, (-1.0, 1.0), strict=True):
        aside = [
            predicted_growth_rate(*loop, rates, assumed_s=0.613, delay_s=end_s + way * s, measured=seen)
            for s in (-1e-6, 1e-6)
        ]
        assert aside[0] < 0.0 < aside[1]
    # a lag that is computed leaves 10 % more than one that is measured
    assert window_s[1] > mismatch_window(*loop, rates, assumed_s=0.613)[1]


SLOW = FormationModel((-1, 0), axes=1).overlapping_gain([[-1.704]], [[0.3]], [[1.402]])
FAST = FormationModel((-1, 0), axes=1).overlapping_gain([[-K1]], [[0.631]], [[K3]])


@pytest.mark.parametrize(
    ("gain", "rates", "assumed_s"),
    [
        # eigenvalues leave the unit circle in pairs, or at z = -1, and others soon after
        (SLOW, Timing(1.0 / 5.0, 1.0 / 1.289), 0.6),
        (SLOW, Timing(1.0 / 5.0, 1.0 / 1.289), 1.0),
        (FAST, Timing(0.02, 0.1), 1.5),
        (FAST, Timing(0.05, 0.02), 3.0),
        (FAST, Timing(1.0 / 200.0, 1.0 / 30.0), 1.5),
        (FAST, RATES, 3.0),
    ],
)
def test_the_lifted_map_is_stable_just_within_a_window(gain: FloatArray, rates: Timing, assumed_s: float) -> None:
    """The spectrum of a map in time, at every delay looked at, against zeros of a determinant on the unit circle."""
    model = FormationModel((-1, 0), axes=1)
    plants = held_blocks(model.A, model.B, gain, period_s=rates.common_s)

    def radius_at(delay_s: float) -> float:
        return max(
            lifted_radius(plant, rates, delay_s=delay_s, predictor=Predictor(plant, assumed_s)) for plant in plants
        )

    window_s = mismatch_window(model.A, model.B, gain, rates, assumed_s=assumed_s)
    for end_s in window_s:
        if end_s > 0.0:
            # 1e-6 of the mismatch changes the radius by 1e-8 and more; its rounding is 1e-12
            within, beyond = (radius_at(assumed_s + share * (end_s - assumed_s)) for share in (1.0 - 1e-6, 1.0 + 1e-6))
            assert within < 1.0 < beyond
        assert all(radius_at(at_s) < 1.0 for at_s in np.linspace(assumed_s, end_s, 6)[:-1].tolist())


def test_the_nearer_of_two_ends_close_together_is_found() -> None:
    """Two equal axes, coupled by a thousandth, cross within 0.3 ms of each other: the map tells which is first."""
    A, B, K = follower(lag_s=0.15)
    axes = np.array([[1.0, 1e-3], [1e-3, 1.001]])
    coupled = np.kron(np.eye(2), A), np.kron(np.eye(2), B), np.kron(axes, K)
    window_s = mismatch_window(*coupled, RATES, assumed_s=1.0)
    for end_s, way in zip(window_s, (-1.0, 1.0), strict=True):
        for aside_s, is_stable in ((-1e-7, True), (1e-7, False)):
            growth_1_s = predicted_growth_rate(*coupled, RATES, assumed_s=1.0, delay_s=end_s + way * aside_s)
            assert (growth_1_s < 0.0) == is_stable


@pytest.mark.parametrize("seed", range(12))
def test_both_analyses_of_two_delays_give_one_continuous_window(seed: int) -> None:
    """Loci of the predicted loop, against crossings of every delay counted from those unstable without any."""
    rng = np.random.default_rng(seed)
    k1 = float(np.exp(rng.uniform(-1.0, 1.5)))
    k3, lag_s = k1**2 * float(np.exp(rng.uniform(-3.0, 0.0))), float(rng.choice([0.0, 0.2])) / k1
    A, B, K = follower(k1, k3, lag_s=lag_s)
    assumed_s = float(rng.uniform(0.1, 4.0)) / k1
    late = B @ K @ expm(A * assumed_s)
    terms = [DelayedTerm(A + B @ K, 0.0, 0), DelayedTerm(late, 0.0, 1), DelayedTerm(-late, assumed_s, 0)]
    blocks = distinct_blocks(*(term.matrix for term in terms))
    analysis = combined_analysis([analyse_mixed_block(block, terms, False) for block in blocks], assumed_s)
    windows = analysis.stable_intervals_s
    wanted = [window for window in windows if window[0] <= assumed_s < window[1]]
    assert wanted == [pytest.approx(mismatch_window_continuous(A, B, K, assumed_s=assumed_s), rel=1e-9)]


def test_a_computed_response_ends_its_continuous_window_on_the_axis() -> None:
    A, B, K = follower(lag_s=0.15)
    carried = np.zeros((3, 3))
    carried[:2, :2] = expm(A[:2, :2] * 0.6)
    for end_s in mismatch_window_continuous(A, B, K, assumed_s=0.6, measured=POSITION_AND_VELOCITY):
        late = B @ K @ carried
        root = rightmost_root([(A + B @ K, 0.0), (late, end_s), (-late, 0.6)])
        assert root.real == pytest.approx(0.0, abs=1e-9)


def test_a_measured_state_that_a_computed_one_needs_is_refused() -> None:
    with pytest.raises(BadModelError, match="measured"):
        mismatch_window(*follower(), RATES, assumed_s=0.3, measured=[True, False])


def test_half_the_speed_tolerates_268_ms_at_1_5_s() -> None:
    least_s, most_s = mismatch_window(*follower(K1 / 2.0, K3 / 4.0), RATES, assumed_s=1.5)
    assert int(1e3 * min(1.5 - least_s, most_s - 1.5)) == 268


def test_a_modelled_lag_leaves_the_published_window_and_decay() -> None:
    loop = follower(lag_s=0.15)
    least_s, most_s = mismatch_window(*loop, RATES, assumed_s=1.5)
    # printed as +50 / -60 ms; the ends are at +51.98 and -60.86 ms, where the map by its definition has radius one
    assert (most_s - 1.5, 1.5 - least_s) == pytest.approx((0.0520, 0.0609), abs=1e-4)
    for end_s in (least_s, most_s):
        assert radius(loop, PERIOD_S, end_s, 1.5) == pytest.approx(1.0, abs=1e-9)
    assert predicted_growth_rate(*loop, RATES, assumed_s=1.5, delay_s=1.5) == pytest.approx(-1.66, abs=5e-3)
    for believed_s in (0.10, 0.15, 0.20):
        assert believed_radius(loop, follower(lag_s=believed_s)) < 1.0
    # a prediction that assumes no lag is unstable
    none = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.array([[0.0], [1.0], [0.0]]), loop[2]
    assert believed_radius(loop, none) > 1.0


@pytest.mark.parametrize("seed", range(30))
def test_crossings_and_the_spectrum_of_the_lifted_map_agree(seed: int) -> None:
    """Random gains, periods, lags and assumed delays, most of them no multiple of the period."""
    rng = np.random.default_rng(seed)
    k1 = float(np.exp(rng.uniform(-1.0, 2.0)))
    k3, lag_s = k1**2 * float(np.exp(rng.uniform(-3.0, 0.3))), float(rng.choice([0.0, 0.2])) / k1
    period_s = float(np.exp(rng.uniform(-2.5, 0.0))) / k1
    assumed_s = float(rng.uniform(0.0, 10.0) if seed % 4 else rng.integers(0, 10)) * period_s
    loop = follower(k1, k3, lag_s=lag_s)
    found = mismatch_window(*loop, Timing(period_s, period_s), assumed_s=assumed_s)
    if radius(loop, period_s, assumed_s, assumed_s) >= 1.0:
        assert found == (assumed_s, assumed_s)
        return

    most_s = min(found[1], 2.0 * assumed_s + 8.0 * period_s)
    for delay_s in np.linspace(found[0], most_s, 42)[1:-1].tolist():
        assert radius(loop, period_s, delay_s, assumed_s) < 1.0
    for end_s, way in ((found[0], -1.0), (found[1], 1.0)):
        if 0.0 < end_s < inf:
            # at a double eigenvalue the radius is known to the root of rounding
            assert radius(loop, period_s, end_s, assumed_s) == pytest.approx(1.0, abs=1e-7)
            assert radius(loop, period_s, end_s + 1e-4 * way * period_s, assumed_s) > 1.0


def test_the_continuous_window_ends_with_a_root_on_the_axis() -> None:
    A, B, K = follower()
    for assumed_s in (0.6, 1.5):
        late = B @ K @ expm(A * assumed_s)
        for end_s in mismatch_window_continuous(A, B, K, assumed_s=assumed_s):
            root = rightmost_root([(A + B @ K, 0.0), (late, end_s), (-late, assumed_s)])
            assert root.real == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("assumed_s", "mismatch_s"), [(0.6, 0.14), (0.6, -0.13), (0.313, 0.22)])
def test_a_simulated_flight_grows_as_the_lifted_map_says(assumed_s: float, mismatch_s: float) -> None:
    model = FormationModel((-1, 0), axes=1)
    K = model.overlapping_gain([[-K1]], [[0.63]], [[K3]])
    for beyond in (0.0, 1.2 * mismatch_s):
        delay_s = assumed_s + mismatch_s + beyond * 0.5
        wanted = predicted_growth_rate(model.A, model.B, K, RATES, assumed_s=assumed_s, delay_s=delay_s)
        grown = flown_growth(model, K, delays_s=[delay_s] * 2, assumed_s=[assumed_s] * 2, duration_s=60.0)
        # the peak of the oscillation is read at 50 Hz over 20 s
        assert grown == pytest.approx(wanted, abs=0.02)
        assert (grown < 0.0) == (beyond == 0.0)


@pytest.mark.parametrize(("mismatch_s", "duration_s"), [(0.13, 45.0), (-0.12, 45.0)])
def test_flights_with_slower_telemetry_grow_as_the_multirate_map_says(mismatch_s: float, duration_s: float) -> None:
    """Five commands from each sample, each predicted anew."""
    model, assumed_s, delay_s = FormationModel((-1, 0), axes=1), 0.607, 0.607 + mismatch_s
    K = model.overlapping_gain([[-K1]], [[0.63]], [[K3]])
    wanted = predicted_growth_rate(model.A, model.B, K, Timing(PERIOD_S, 0.1), assumed_s=assumed_s, delay_s=delay_s)
    flight = {"delays_s": [delay_s] * 2, "assumed_s": [assumed_s] * 2}
    grown = flown_growth(model, K, **flight, telemetry_s=0.1, duration_s=duration_s)
    assert grown == pytest.approx(wanted, abs=0.03)


def test_every_multirate_window_ends_where_its_map_has_radius_one() -> None:
    for rates in (Timing(0.02, 0.1), Timing(0.02, 0.05), Timing(0.05, 0.02), Timing(0.1, 0.02)):
        window_s = mismatch_window(*follower(), rates, assumed_s=1.004)
        for end_s in window_s:
            assert predicted_growth_rate(*follower(), rates, assumed_s=1.004, delay_s=end_s) == pytest.approx(
                0.0, abs=1e-6
            )
        assert window_s[0] < 1.004 < window_s[1]
    # 50 Hz commands from 10 Hz telemetry keep the decay of 50 Hz
    assert predicted_growth_rate(*follower(), Timing(0.02, 0.1), assumed_s=0.6, delay_s=0.6) == pytest.approx(
        -1.735, abs=5e-4
    )


def test_a_search_that_begins_at_angle_zero_finds_the_window() -> None:
    """Telemetry at a quarter of the control rate and 10 s assumed: a starting angle is too small for a difference."""
    model, rates = FormationModel((-1, 0), axes=1), Timing(0.05, 0.2)
    K = model.overlapping_gain([[-2.707704873573067]], [[0.3321720783944292]], [[3.418066695822439]])
    window = mismatch_window(model.A, model.B, K, rates, assumed_s=10.0)
    for end_s, outwards in zip(window, (-1.0, 1.0), strict=True):
        for aside_s in (-1e-4, 1e-4):
            growth_1_s = predicted_growth_rate(
                model.A, model.B, K, rates, assumed_s=10.0, delay_s=end_s + outwards * aside_s
            )
            assert (growth_1_s > 0.0) == (aside_s > 0.0)


def test_the_whole_formation_is_stable_exactly_where_each_vehicle_is() -> None:
    """triangle5 in one matrix: the spectrum is the union of those of the blocks, inside and beyond their windows."""
    model = FormationModel((-1, 0, 1, 0, 3), axes=1)
    K = model.overlapping_gain([[-K1]], [[0.63]], [[K3]])
    rates, assumed_s = Timing(0.1, 0.1), 0.64
    window_s = mismatch_window(model.A, model.B, K, rates, assumed_s=assumed_s)
    assert window_s == pytest.approx(mismatch_window(*follower(), rates, assumed_s=assumed_s), abs=1e-9)
    for end_s, way in zip(window_s, (-0.01, 0.01), strict=True):
        for delay_s, is_stable in ((end_s - way, True), (end_s + way, False)):
            whole = lifted((model.A, model.B, K), 0.1, delay_s, assumed_s)
            block = lifted(follower(), 0.1, delay_s, assumed_s)
            # five followers share each eigenvalue, chains of two of them, which rounding spreads to its root
            largest = float(np.abs(np.linalg.eigvals(whole)).max())
            assert largest == pytest.approx(float(np.abs(np.linalg.eigvals(block)).max()), abs=1e-5)
            assert (largest < 1.0) == is_stable


def test_a_delay_outside_one_vehicles_window_makes_errors_grow() -> None:
    """Three vehicles, each with its own delay: the flight grows once one of these leaves its window."""
    model = FormationModel((-1, 0, 1), axes=1)
    K = model.overlapping_gain([[-K1]], [[0.63]], [[K3]])
    assumed_s = [0.31, 0.6, 0.853]
    windows_s = [mismatch_window(*follower(), RATES, assumed_s=each_s) for each_s in assumed_s]
    inside = [0.4, 0.65, 0.88]
    assert all(least < delay < most for (least, most), delay in zip(windows_s, inside, strict=True))
    assert flown_growth(model, K, delays_s=inside, assumed_s=assumed_s, duration_s=40.0) < -0.1
    for i in (1, 2):
        delays_s = list(inside)
        delays_s[i] = windows_s[i][1] + 0.03
        wanted = predicted_growth_rate(*follower(), RATES, assumed_s=assumed_s[i], delay_s=delays_s[i])
        grown = flown_growth(model, K, delays_s=delays_s, assumed_s=assumed_s, duration_s=40.0)
        assert 0.0 < wanted == pytest.approx(grown, abs=0.03)


def test_a_formation_of_lagging_vehicles_has_its_blocks_window() -> None:
    model = FormationModel((-1, 0, 1), axes=2)
    identity = np.eye(2)
    K = model.overlapping_gain(-K1 * identity, 0.63 * identity, K3 * identity)
    loop = formation_loop(model, K, [Response(0.15, 0.0)] * 3)
    assert mismatch_window(*loop, RATES, assumed_s=0.7) == pytest.approx(
        mismatch_window(*follower(lag_s=0.15), RATES, assumed_s=0.7), abs=1e-9
    )


def test_an_assumed_delay_that_is_no_delay_is_refused() -> None:
    for assumed_s in (-0.1, inf, float("nan")):
        with pytest.raises(BadModelError, match="assumed_s"):
            mismatch_window(*follower(), RATES, assumed_s=assumed_s)


def test_gains_that_are_unstable_without_delay_have_no_window() -> None:
    assert mismatch_window(*follower(-1.0, 1.0), RATES, assumed_s=0.4) == (0.4, 0.4)
    assert mismatch_window_continuous(*follower(-1.0, 1.0), assumed_s=0.4) == (0.4, 0.4)
