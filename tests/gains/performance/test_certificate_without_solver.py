"""The proof of alpha where no semidefinite solver is installed: the same bound from a Riccati equation."""

import sys

import numpy as np
import pytest

from gains.core.errors import GainsError
from gains.core.requirement import Requirement
from gains.design.design import design
from gains.formation.model import FormationModel
from gains.performance.robust import certify, robustness

K1, K2, K3 = (value * np.eye(2) for value in (-3.4, 3.1, 5.6))


def test_riccati_equation_proves_alpha_up_to_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    alpha = robustness(K1, K2, K3)
    proof = certify(K1, K2, K3, (1.0 - 1e-4) * alpha)
    assert proof.solver.name == "Riccati equation"
    assert proof.P_eigenvalue_min > 0.0
    assert proof.s_procedure_eigenvalue_max < 0.0
    with pytest.raises(GainsError):
        certify(K1, K2, K3, 1.001 * alpha)


def test_design_needs_no_solver_for_its_certificate(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = FormationModel((-1, 0)), Requirement(delay_margin_s=0.3)
    with_solver = design(*loop, period_s=0.02)
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    without = design(*loop, period_s=0.02)
    assert np.array_equal(with_solver.K1, without.K1)
    assert without.certificate is not None
    assert without.certificate.alpha == pytest.approx(0.9999 * without.alpha, rel=1e-6)
