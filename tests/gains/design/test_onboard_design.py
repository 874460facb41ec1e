"""A design for the loop on board: string stability is judged, searched and certified in the loop that is flown."""

import numpy as np
import pytest

from gains.core.requirement import Requirement
from gains.design.design import design
from gains.design.required import required_gains
from gains.formation.model import FormationModel
from gains.performance.flown_loop import FlownLoop
from gains.performance.scalar_gains import ScalarGains, onboard_front_gain_limit
from gcs.plan.planner import flight_plan
from scenarios.files import load, with_loop
from tests.support.paths import ROOT

FILE = ROOT / "scenarios/triangle5.toml"


def growth(gains: ScalarGains, delay_s: float) -> float:
    """Largest |Γ| of k3 + k2 s e^{−sτ} over s² + k1 s + k3 on a dense grid."""
    s = 1j * np.geomspace(1e-3, 1e2, 50_001)
    late = gains.k3 + gains.k2 * s * np.exp(-s * delay_s)
    return float(np.abs(late / (s**2 + gains.k1 * s + gains.k3)).max())


def test_on_board_no_error_grows_at_any_delay_where_the_ground_design_lets_it() -> None:
    ground, onboard = (required_gains(Requirement(0.3, None, 1.0, loop=loop), 0.02) for loop in ("ground", "onboard"))
    delays_s = [0.1, 0.5, 1.0, 3.0]
    assert min(growth(ground, delay_s) for delay_s in delays_s) > 1.0005
    assert growth(ground, 0.5) == pytest.approx(1.039, abs=1e-3)
    assert growth(ground, 1.0) == pytest.approx(1.083, abs=1e-3)
    assert max(growth(onboard, delay_s) for delay_s in delays_s) <= 1.0 + 1e-12
    assert onboard.k2 == 0.0
    assert 0.8137 < onboard.alpha < ground.alpha


@pytest.mark.parametrize("peak", [1.02, 1.2, 2.0])
def test_a_growth_that_is_allowed_is_reached_at_the_worst_delay_and_not_passed(peak: float) -> None:
    found = required_gains(Requirement(0.3, None, peak, loop="onboard"), 0.02)
    most = float(onboard_front_gain_limit(np.array([found.k1]), np.array([found.k3]), peak)[0])
    assert abs(found.k2) <= most * (1.0 + 1e-9)
    delays_s = np.linspace(0.0, 6.0, 241)
    at_limit = ScalarGains(found.k1, most, found.k3, 0.0)
    worst = max(growth(at_limit, delay_s) for delay_s in delays_s.tolist())
    assert worst <= peak * (1.0 + 1e-6)
    assert worst == pytest.approx(peak, rel=1e-2)  # delays in steps of 25 ms


def test_the_design_of_a_scenario_is_that_of_its_loop() -> None:
    scenario = with_loop(load(FILE), "onboard", FILE)
    found, plan = flight_plan(scenario)
    assert found.K2_1_s == ((0.0, 0.0), (0.0, 0.0))
    assert found.requirement is not None
    assert found.requirement.loop == "onboard"
    flown = found.at_loop_delay
    assert flown is not None
    assert (flown.string_peak, flown.string_peak_kept_to_s, flown.alpha_kept_to_s) == (1.0, None, None)
    assert plan.delay_margin_s == np.inf


def test_the_certificate_of_an_onboard_design_proves_its_alpha_at_every_delay() -> None:
    found = design(FormationModel((-1, 0, 1)), Requirement(0.3, None, 1.0, loop="onboard"), period_s=0.02)
    assert found.certificate is not None
    gains = ScalarGains(-found.K1[0, 0], found.K2[0, 0], found.K3[0, 0], 0.0)
    flown = FlownLoop(gains, np.inf, 0.02, "onboard")
    assert min(flown.alpha(delay_s) for delay_s in (0.0, 0.3, 2.0)) >= found.certificate.alpha
