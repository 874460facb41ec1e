"""`gcs thesis`: the figures and numbers of the source, as printed and as computed.

Source: P. R. Sahoo, "Decentralized Control Design Approaches for Formation Control of Unmanned Aerial Vehicles", M.Tech
thesis, NIT Rourkela, 2012. Each number that contradicts it is computed by two independent methods.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import compress, islice, product
from pathlib import Path

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.requirement import Requirement
from gains.delay.constant import delay_margin
from gains.delay.rightmost import rightmost_root
from gains.delay.sweep import frequency_sweep_margin
from gains.design.design import design
from gains.design.dk_iteration import abscissa, dk_iteration
from gains.design.robust_lmi import robust_lmi
from gains.formation.bipartite import expanded_gain, partition_by_input, verify_expansion
from gains.formation.inclusion import Restriction, contracted_gain, expand, modified_gain, verify_inclusion
from gains.formation.inclusion import expanded_gain as inclusion_gain
from gains.formation.model import FormationModel
from gains.formation.pattern import Pattern, bidirectional, checked_pattern_gain, formation_plant, leader_follower
from gains.margin.opinions import checked_delay_margin
from gains.sampled.onboard import own_part
from gcs.stress.disturbance import find_disturbance_onsets
from gcs.studies import thesis_flights
from gcs.studies.thesis_flights import ALPHA, CHAIN, DELAYS_S, SINGLE, flown, printed_gains
from gcs.views.page import rendered

PAGE_FILE = "thesis.md"
PUBLISHED_S = (0.185, 0.195)
"""Range of values that round to the published 0.19 s."""


@dataclass(frozen=True)
class Claim:
    """One number or statement of the source: its place, printed and computed value, and a second, independent check."""

    place: str
    subject: str
    published: str
    computed: str
    second: str
    verdict: str
    """"agrees", "erratum", "holds with conditions", or "not checkable": nothing was printed to compare with."""


def claims(ended: Callable[[int], None] = lambda _: None) -> list[Claim]:
    """All claims, in the order of the source; `ended` is called after each part with the number left."""
    parts = (_modelling, _inclusion, _disturbance, _expansion, _graph, _sweep_algorithm, _delay, _subsets, _comparison)
    found: list[Claim] = []
    for left, part in zip(reversed(range(len(parts))), parts, strict=True):
        found += part()
        ended(left)
    return found


def late_neighbours(K: FloatArray, pattern: Pattern) -> tuple[FloatArray, FloatArray]:
    """(A0, A1) of (5.2): a vehicle's own errors are fed back at once, those of others with delay."""
    own = own_part(CHAIN, checked_pattern_gain(pattern, K))
    return CHAIN.A + CHAIN.B @ own, CHAIN.B @ (K - own)


def _modelling() -> Iterator[Claim]:
    start = np.zeros(CHAIN.states)
    start[CHAIN.velocity_slice(0)], start[CHAIN.spacing_slice(1)] = (5.0, -3.0), (20.0, 10.0)
    K = printed_gains()
    _, flown = thesis_flights.fly_with_late_neighbours(K, start, delay_s=0.0, duration_s=1.0)
    # the same hold of 1 ms in the linear model: one matrix exponential per step
    generator = np.zeros((CHAIN.states + CHAIN.inputs,) * 2)
    generator[: CHAIN.states] = np.hstack([CHAIN.A, CHAIN.B])
    from scipy.linalg import expm

    step = expm(generator * 1e-3)[: CHAIN.states]
    linear = [start]
    for _ in range(len(flown) - 1):
        linear.append(step @ np.concatenate([linear[-1], K @ linear[-1]]))
    gap = float(np.abs(flown - np.array(linear)).max())
    yield Claim(
        "(2.2)-(2.12)", "M(ξ) makes the vehicle a planar double integrator", "exactly",
        f"{gap:.1e} m or m/s apart over 1 s", "nonlinear RK4 against the matrix exponential of (2.12)", "agrees",
    )  # fmt: skip


def _inclusion() -> Iterator[Claim]:
    found = design(CHAIN, Requirement(alpha=ALPHA), period_s=thesis_flights.PERIOD_S)
    gains = found.K1, found.K2, found.K3
    K = CHAIN.overlapping_gain(*gains)
    worst = 0.0
    for restriction in ("a", "b"):
        expansion = expand(CHAIN, restriction)
        K_expanded = modified_gain(CHAIN, inclusion_gain(CHAIN, *gains))
        worst = max(worst, verify_inclusion(expansion, CHAIN.A, CHAIN.B, K=K, K_expanded=K_expanded))
        worst = max(worst, float(np.abs(contracted_gain(expansion, K_expanded) - K).max()))
    yield Claim(
        "(3.5)-(3.19)", "conditions of the inclusion, types (a) and (b), and the contracted gain", "hold",
        f"largest residual {worst:.1e}", "contracted gain against the pattern (3.19)", "agrees",
    )  # fmt: skip
    # block (2, 2) of A Y + Y A' + B L + L'B' is zero: the spacing error does not drive itself and has no input
    middle = float(np.abs(CHAIN.A[2:4, 2:4]).max() + np.abs(CHAIN.B[2:4]).max())
    yield Claim(
        "(3.29)", "the LMI with Y = diag(Y1, Y2, Y1)", "α = 0.93",
        f"infeasible: its block (2, 2) is {middle:.0f} for every Y and L, so it is never negative definite",
        f"{_least_eigenvalue():.1e} is the smallest value of the largest eigenvalue of AY + YA' + BL + L'B' over 2,000 "
        "random Y, L",
        "erratum",
    )  # fmt: skip
    shears = (-1.0, -2.0, -3.0)
    reached = ", ".join(f"{robust_lmi(shear=c, gain_bound=1e3, lyapunov_bound=1e3).alpha:.4f}" for c in shears)
    closed = ", ".join(f"{abs(c) / (1 + c * c) ** 0.5:.4f}" for c in shears)
    c = -ALPHA / (1 - ALPHA**2) ** 0.5
    yield Claim(
        "(3.29)", "α = 0.93, with sheared coordinates", "0.93",
        f"{ALPHA} at shear {c:.2f} 1/s, by |c|/√(1 + c²)",
        f"Clarabel at c = −1, −2, −3: {reached}; closed form {closed}",
        "agrees",
    )  # fmt: skip
    yield Claim(
        "3.4", "what α = 0.93 costs", "not asked",
        f"delay margin {1e3 * found.delay_margin_s:.0f} ms sampled at 50 Hz, all feedback late",
        f"{1e3 * frequency_sweep_margin(CHAIN.A, CHAIN.B @ K):.0f} ms continuous by the frequency sweep",
        "not checkable",
    )  # fmt: skip


def _disturbance() -> Iterator[Claim]:
    _, plan = thesis_flights.planned("triangle5", "inclusion")
    found = find_disturbance_onsets(plan, tolerance=0.01, kinds=("dynamic",), counts=(2,))
    [onset] = found.onsets
    assert onset.onset_1_s is not None
    yield Claim(
        "(3.20)-(3.24)", "disturbance w: stable under every |w| ≤ α |e| of a follower and the vehicle in front",
        f"{ALPHA}, not flown",
        f"the worst w makes the formation unstable from {onset.onset_1_s:.4f} 1/s on in flight, at "
        f"{1e3 * found.loop_delay_s:.0f} ms of loop delay: `gcs stress SCENARIO --disturbance --onset`",
        f"complex stability radius of the sampled loop {onset.radius_1_s:.4f} 1/s", "agrees",
    )  # fmt: skip


def _expansion() -> Iterator[Claim]:
    (rank_a, hautus_a), (rank_b, hautus_b) = (controllable_dimensions(kind) for kind in ("a", "b"))
    yield Claim(
        "4.5, 6.1", "“the expanded system is uncontrollable”", "uncontrollable",
        f"of (3.13), type (a), {rank_a} of 7 dimensions an axis are controllable: all; only of type (b) they are "
        f"{rank_b}", f"rank of [A, B] at the one eigenvalue, 0: {hautus_a} and {hautus_b} of 7", "erratum",
    )  # fmt: skip
    _, minus, plus = s_procedure_counterexample()
    yield Claim(
        "3.3", "S-procedure: F > 0 wherever G ≤ 0 follows from F + τG ≻ 0", "without that sign",
        f"F = G = −1: F > 0 nowhere, yet F − τG ≻ 0 {'for some' if minus else 'for no'} τ ≥ 0",
        f"F + τG ≻ 0 {'for some' if plus else 'for no'} τ ≥ 0", "erratum",
    )  # fmt: skip


def _sweep_algorithm() -> Iterator[Claim]:
    (least, _), (least_late, most_late) = pencil_moduli(-2.0, 1.0), pencil_moduli(-1.0, -2.0)
    yield Claim(
        "(5.7)", "no delay destabilises if ρ(jωI − A0, A1) < 1", "ρ < 1",
        f"the condition must be on the least modulus, above 1: x' = −2x + x(t − τ) has it at {least:.1f} and margin "
        f"{delay_margin([[-2.0]], [[1.0]])}; no loop has a largest one below 1, as |λ| grows with ω",
        f"x' = −x − 2x(t − τ): least {least_late:.1f}, margin {delay_margin([[-1.0]], [[-2.0]]):.4f} s; moduli pass 1 "
        f"on the way to {most_late:.0f} at 100 rad/s", "erratum",
    )  # fmt: skip
    right, wrong = (first_crossing(-1.0, -2.0, sign) for sign in (-1.0, 1.0))
    yield Claim(
        "(5.7), steps 2, 3", "crossings from ρ ≠ 0, and θ without e^{−jθ}", "ρ ≠ 0, λ = e^{jθ}",
        f"the condition to search for is |λ| = 1, with λ = e^{{−jθ}}: θ/ω = {right:.4f} s for x' = −x − 2x(t − τ); "
        f"with e^{{jθ}} {wrong:.4f} s",
        f"exact margin {delay_margin([[-1.0]], [[-2.0]]):.4f} s = 2π / (3√3)", "erratum",
    )  # fmt: skip


def _subsets() -> Iterator[Claim]:
    margins = subset_margins()
    low, high = PUBLISHED_S
    inside = int(((margins >= low) & (margins <= high)).sum())
    nearest = int(np.argmin(np.abs(margins - 0.19)))
    yield Claim(
        "5.3", "any choice of late gains, of the twelve scalar ones, that gives 0.19 s", "0.19 s",
        f"{inside or 'none'} of all {len(margins):,} gives {low} to {high} s; the nearest is {margins[nearest]:.4f} s",
        f"{subset_margin_by_sweep(nearest):.4f} s by the sweep", "erratum",
    )  # fmt: skip


def _least_eigenvalue() -> float:
    """The smallest value, over random Y, L, of the largest eigenvalue of AY + YA' + BL + L'B' of (3.25), per axis."""
    A = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    B = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    rng = np.random.default_rng(2012)
    least = np.inf
    for y1, y2, l1, l2, l3 in rng.normal(size=(2000, 5)) * 10.0:
        Y, L = np.diag([y1 * y1, y2 * y2, y1 * y1]), np.array([[l1, 0.0, 0.0], [l2, l3, l1]])
        drift = A @ Y + B @ L
        least = min(least, float(np.linalg.eigvalsh(drift + drift.T)[-1]))
    return least


def _graph() -> Iterator[Claim]:
    pattern, plant = leader_follower(CHAIN), formation_plant(CHAIN)
    partition = partition_by_input(pattern)
    expanded = expanded_gain(pattern, partition)
    K = CHAIN.overlapping_gain(*(g * np.eye(2) for g in (-3.4, 0.6, 5.6)))
    rows, columns = expanded.mask.shape
    yield Claim(
        "(4.6), (4.7)", "partition by input", "{K11}, {K21, K22}, {K32, K33}; K̄ 6×16, φ2 16×10",
        f"{len(partition)} subgraphs; K̄ {rows}×{columns}, φ2 {columns}×{expanded.phi2.shape[1]}",
        f"closed-loop modes differ by {verify_expansion(plant, expanded, K):.0e} from those of K", "agrees",
    )  # fmt: skip
    # of PA + A'P + αI at P = I, K = 0
    printed = float(np.linalg.eigvalsh(CHAIN.A + CHAIN.A.T - 1e6 * np.eye(CHAIN.states))[-1])
    steps = dk_iteration(formation_plant(SINGLE), Pattern(pattern.blocks, (1, 1, 1), (1, 2, 2)))
    yield Claim(
        "4.4", "“… + αI ⪯ 0, minimise α”", "converges",
        "unbounded below: α = −10⁶ satisfies it with P = I, K = 0 (largest eigenvalue "
        f"{printed:.0f}), and so does every smaller α",
        f"with αP and I ⪯ P ⪯ κI the iteration ends after {len(steps.iterates) - 1} steps at "
        f"α = {steps.proof.alpha:.3f}, abscissa {abscissa(SINGLE.A + SINGLE.B @ steps.K):.3f} 1/s", "erratum",
    )  # fmt: skip
    norm = float(np.linalg.norm(printed_gains(), 2))
    largest = max(
        float(np.linalg.norm(printed_gains()[CHAIN.input_slice(i), CHAIN.output_slice(j)], 2))
        for i, j in product(range(3), range(3))
    )
    yield Claim(
        "5.2.2", "gains within [[k̄, K], [K', I]] ≻ 0, k̄ < 100", "‖K‖ < 10",
        f"‖K‖ = {norm:.2f}", f"largest block norm {largest:.2f}", "erratum",
    )  # fmt: skip


def _delay() -> Iterator[Claim]:
    K, pattern = printed_gains(), bidirectional(CHAIN)
    A0, A1 = late_neighbours(K, pattern)
    yield Claim(
        "5.3", "delay margin under (5.2)", "0.19 s",
        f"{checked_delay_margin(A0, A1):.5f} s, algebraic",
        f"{frequency_sweep_margin(A0, A1):.5f} s by the sweep of Theorem 2; the rightmost root agrees on both sides",
        "erratum",
    )  # fmt: skip
    slipped = K.copy()
    slipped[CHAIN.input_slice(2).start, CHAIN.spacing_slice(2).start] = 0.5003
    yield Claim(
        "5.2.2", "k33 with “0.5003” as printed", "0.19 s",
        f"{delay_margin(*late_neighbours(slipped, pattern)):.5f} s: the slip does not explain it",
        f"{frequency_sweep_margin(*late_neighbours(slipped, pattern)):.5f} s by the sweep", "erratum",
    )  # fmt: skip
    yield Claim(
        "5.3", "the same gains with all feedback late", "not asked",
        f"{delay_margin(CHAIN.A, CHAIN.B @ K):.6f} s",
        f"{frequency_sweep_margin(CHAIN.A, CHAIN.B @ K):.6f} s by the sweep", "not checkable",
    )  # fmt: skip
    names, parts = zip(*_parts(K), strict=True)
    splits = [(chosen, delay_margin(*loop)) for chosen, loop in late_choices(CHAIN, K, parts)]
    chosen, margin_s = min(splits, key=lambda split: abs(split[1] - 0.19))
    yield Claim(
        "5.3", "any split into late and immediate feedback that gives 0.19 s", "0.19 s",
        f"none of {len(splits)}: the nearest is {margin_s:.4f} s ({', '.join(compress(names, chosen))} late)",
        "own and others' velocity and spacing errors, each late or not", "erratum",
    )  # fmt: skip
    late = CHAIN.overlapping_gain(*(g * np.eye(2) for g in (-3.4, 0.6, 5.6)))
    now, delayed = late_neighbours(late, leader_follower(CHAIN))
    independent = delay_margin(now, delayed)
    yield Claim(
        "5.2", "leader-follower pattern under (5.2)", "not said",
        f"margin {independent}: the delayed terms are off the diagonal blocks",
        f"abscissa {abscissa(now):.4f} 1/s without the delayed terms, {abscissa(now + delayed):.4f} 1/s with them, "
        "undelayed", "not checkable",
    )  # fmt: skip
    for delay_s in DELAYS_S:
        root = rightmost_root([(A0, 0.0), (A1, delay_s)])
        rate, settled_s = thesis_flights.nonlinear_response(delay_s)
        if delay_s == DELAYS_S[0]:
            yield Claim(
                "5.4", "responses at h = 0.17 s", "settle in about 3.5 s",
                f"rightmost root {root.real:.3f} 1/s; nonlinear flight within 2 % after {settled_s:.1f} s",
                f"growth rate of the nonlinear flight {rate:.3f} 1/s", "agrees",
            )  # fmt: skip
        else:
            yield Claim(
                "5.3", f"the same at h = {delay_s} s", "beyond its margin of 0.19 s",
                f"{'' if root.real < 0 else 'un'}stable: rightmost root {root.real:+.4f} ± {abs(root.imag):.2f}j 1/s",
                f"growth rate of the nonlinear flight {rate:+.4f} 1/s", "erratum" if root.real < 0 else "agrees",
            )  # fmt: skip


def _parts(K: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    spacing = np.isin(np.arange(CHAIN.states), [k for i in CHAIN.followers for k in np.r_[CHAIN.spacing_slice(i)]])
    own = own_part(CHAIN, K)
    for whose, gain in (("own", own), ("others'", K - own)):
        yield f"{whose} velocity", np.where(spacing, 0.0, gain)
        yield f"{whose} spacing", np.where(spacing, gain, 0.0)


def _comparison() -> Iterator[Claim]:
    texts: list[str] = []
    for name in ("triangle5", "triangle5_scattered"):
        inclusion_s, dk_s, lqr_s = (flown(name, method)[1] for method in ("inclusion", "graph-dk", "graph-lqr"))
        texts.append(f"{name}: {inclusion_s:.1f} s against {dk_s:.1f} s (D-K) and {lqr_s:.1f} s (LQR)")
    yield Claim(
        "4.5", "“the formation converges about 5 s sooner” with inclusion gains", "about 5 s",
        f"settled to 1 %, each with the margin of α = 0.93, without link delay: {'; '.join(texts)}",
        "decay rates of the designs; gcs compare: at a scenario's own margin, over its links",
        "holds with conditions",
    )  # fmt: skip


def controllable_dimensions(restriction: Restriction) -> tuple[int, int]:
    """Ranks of [B, AB, A²B, ...] and of [A, B], for the expanded chain of three on one axis.

    All eigenvalues are zero, so by Hautus' test the system is controllable if and only if [A, B] has full rank.
    """
    expansion = expand(SINGLE, restriction)
    A, B = expansion.A.toarray(), expansion.B.toarray()
    powers = [np.linalg.matrix_power(A, k) @ B for k in range(len(A))]
    return int(np.linalg.matrix_rank(np.hstack(powers))), int(np.linalg.matrix_rank(np.hstack([A, B])))


def s_procedure_counterexample() -> tuple[bool, bool, bool]:
    """For F = G = −1: whether F > 0 wherever G ≤ 0, whether F − τG > 0 for some τ ≥ 0, and the same for F + τG > 0."""
    F = G = -1.0
    some = np.linspace(0.0, 100.0, 1001)
    return not (G <= 0.0) or F > 0.0, bool((F - some * G > 0.0).any()), bool((F + some * G > 0.0).any())


def pencil_moduli(own: float, late: float) -> tuple[float, float]:
    """Least and largest |λ(jωI − A0, A1)| over frequencies up to 100 rad/s, of x' = own x + late x(t − τ)."""
    moduli = np.abs((1j * np.linspace(0.0, 100.0, 100_001) - own) / late)
    return float(moduli.min()), float(moduli.max())


def first_crossing(own: float, late: float, sign: float) -> float:
    """θ / ω at which λ(jω − A0, A1) = e^{sign jθ}, θ in [0, 2π), of x' = own x + late x(t − τ)."""
    omega = float(np.sqrt(late**2 - own**2))
    return float(np.mod(sign * np.angle((1j * omega - own) / late), 2.0 * np.pi)) / omega


def late_choices(
    model: FormationModel, K: FloatArray, parts: Sequence[FloatArray]
) -> Iterator[tuple[tuple[bool, ...], tuple[FloatArray, FloatArray]]]:
    """Each choice of which parts of K are delayed, at least one, with (A0, A1) of the resulting loop."""
    for chosen in islice(product((False, True), repeat=len(parts)), 1, None):
        late = np.sum(list(compress(parts, chosen)), axis=0)
        yield chosen, (model.A + model.B @ (K - late), model.B @ late)


def _late_entries() -> list[tuple[FloatArray, FloatArray]]:
    """(A0, A1) for each of the 4,095 choices of which of the twelve printed scalar gains are delayed.

    One axis is enough: the blocks are multiples of the identity, except for entries of at most 0.0053.
    """
    K = printed_gains()[::2, ::2]
    places = np.flatnonzero(np.abs(K) > 0.1)
    assert len(places) == 12
    entries = [K * place.reshape(K.shape) for place in np.eye(K.size)[places]]
    return [loop for _, loop in late_choices(SINGLE, K, entries)]


@cache
def subset_margins() -> FloatArray:
    """The delay margin for each choice of which of the twelve printed scalar gains are delayed."""
    margins: list[float] = []
    for now, late in _late_entries():
        try:
            margins.append(delay_margin(now, late))
        except np.linalg.LinAlgError:  # the resolvent is singular on the imaginary axis
            margins.append(frequency_sweep_margin(now, late))
    return np.array(margins)


def subset_margin_by_sweep(number: int) -> float:
    """One of the margins of `subset_margins`, by the frequency sweep."""
    return frequency_sweep_margin(*_late_entries()[number])


def write_page(folder: Path, found: list[Claim]) -> Path:
    thesis_flights.formation_figure(folder / "inclusion.png", "inclusion")
    thesis_flights.formation_figure(folder / "graph.png", "graph-dk")
    thesis_flights.responses_figure(folder / "responses.png")
    page = folder / PAGE_FILE
    page.write_text(rendered("thesis.md.j2", claims=found, alpha=ALPHA) + "\n", encoding="utf-8")
    return page
