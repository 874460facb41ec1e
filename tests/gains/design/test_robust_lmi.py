"""Gains by linear matrix inequalities, against the closed-form supremum and the exact bound."""

import numpy as np
import pytest

from gains.core.errors import BadModelError, SolverError
from gains.design.robust_lmi import centralised_lmi, robust_lmi
from gains.formation.model import FormationModel
from gains.formation.pattern import Plant, formation_plant
from gains.performance.robust import disturbance_bound, robustness, subsystem_loop

CHAIN = formation_plant(FormationModel((-1, 0, 1), axes=1))


@pytest.mark.parametrize(("shear", "supremum"), [(-1.0, 0.7071), (-2.0, 0.8944), (-3.0, 0.9487), (-2.53, 0.9300)])
def test_lmi_reaches_its_supremum_as_the_bounds_get_loose(shear: float, supremum: float) -> None:
    """α(c) = |c| / √(1 + c²) for W = I; the source's published 0.93 is c = −2.53."""
    alphas = [robust_lmi(shear=shear, gain_bound=k, lyapunov_bound=k).alpha for k in (10.0, 30.0, 100.0)]
    assert alphas == sorted(alphas)
    assert alphas[-1] < abs(shear) / np.hypot(1, shear)
    # Figures are printed to four digits; with bounds of 100 the optimum is within 2e-6 of the supremum.
    assert alphas[-1] == pytest.approx(supremum, abs=6e-5)
    assert alphas[-1] == pytest.approx(abs(shear) / np.hypot(1, shear), abs=5e-6)


def test_lmi_gains_have_the_sources_pattern_with_k1_twice() -> None:
    found = robust_lmi(shear=-2.0, gain_bound=10.0, lyapunov_bound=10.0)
    (own, none, nothing), (front, spacing, own_again) = found.K.tolist()
    assert (none, nothing) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert own == pytest.approx(own_again, rel=1e-12)
    # the closed loop of both vehicles as one formation is the subsystem that the source writes
    pair = FormationModel((-1, 0), axes=1)
    assert pytest.approx(subsystem_loop(own, front, spacing), abs=1e-9) == pair.A + pair.B @ found.K


def test_lmi_alpha_is_a_lower_bound_of_the_exact_one() -> None:
    """The full Lyapunov matrix of `robustness` can prove at least what a block-diagonal one in some coordinates can."""
    for shear in (-0.3, -1.0, -2.0):
        gains = robust_lmi(shear=shear, gain_bound=10.0, lyapunov_bound=10.0)
        (_, _, _), (front, spacing, own) = gains.K.tolist()
        assert robustness(own, front, spacing) > gains.alpha


def test_a_solver_error_names_bounds_that_are_too_tight() -> None:
    with pytest.raises(SolverError, match=r"'infeasible'.*gain_bound = 2.*lyapunov_bound = 2"):
        robust_lmi(shear=-5.0, gain_bound=2.0, lyapunov_bound=2.0)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("shear", {"shear": 1.0, "gain_bound": 10.0, "lyapunov_bound": 10.0}),
        ("gain_bound", {"shear": -1.0, "gain_bound": -1.0, "lyapunov_bound": 10.0}),
        ("lyapunov_bound", {"shear": -1.0, "gain_bound": 10.0, "lyapunov_bound": np.nan}),
    ],
)
def test_arguments_out_of_range_are_refused_by_name(name: str, arguments: dict[str, float]) -> None:
    with pytest.raises(BadModelError, match=name):
        robust_lmi(
            shear=arguments["shear"],
            gain_bound=arguments["gain_bound"],
            lyapunov_bound=arguments["lyapunov_bound"],
        )


def test_centralised_lmi_withstands_its_claim_and_keeps_gains_in_bounds() -> None:
    found = centralised_lmi(CHAIN, gain_bound=30.0, lyapunov_bound=30.0)
    exact = disturbance_bound(CHAIN.A + CHAIN.B @ found.K, np.eye(CHAIN.states))
    assert 0.9 < found.alpha <= exact * (1.0 + 1e-6)
    assert np.linalg.norm(found.K, 2) <= 30.0 * 30.0
    wider = centralised_lmi(CHAIN, gain_bound=300.0, lyapunov_bound=30.0)
    assert wider.alpha > found.alpha
    # one integrator: 2 L + 1 < -Y²/γ, so L = -κ_L and Y = 1/κ_Y give α = κ_Y √(2 κ_L - 1)
    one = centralised_lmi(Plant(A=np.zeros((1, 1)), B=np.eye(1)), gain_bound=5.0, lyapunov_bound=2.0)
    assert one.alpha == pytest.approx(2.0 * np.sqrt(2.0 * 5.0 - 1.0), rel=1e-4)
    assert one.K[0, 0] == pytest.approx(-10.0, rel=1e-4)
    with pytest.raises(BadModelError, match="gain_bound = 0"):
        centralised_lmi(CHAIN, gain_bound=0, lyapunov_bound=1.0)
