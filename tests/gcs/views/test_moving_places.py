"""The wanted places that the recording draws for a manoeuvring formation."""

import numpy as np
import pytest

from gcs.views.scene import tree_of
from scenarios.files import load
from tests.support.paths import SCENARIOS


def test_wanted_places_change_sides_turn_and_keep_their_altitude() -> None:
    tree = tree_of(load(SCENARIOS / "patrol.toml"))
    start, crossed = tree.offsets_at_m(np.array([0.0, 64.0]))
    assert start.tolist() == tree.offsets_m.tolist()
    # vehicles 2 to 5 behind 1, 2, 1, 4; forward, right and down, at first northbound
    assert start == pytest.approx(np.array([[-40, 40, 0], [-40, 40, 0], [-40, -40, -15], [-40, -40, 0]]))
    # the last leg leads east
    assert crossed == pytest.approx(np.array([[40, -40, 0], [40, -40, 0], [-40, -40, -15], [-40, -40, 0]]), abs=1e-6)


def test_wanted_places_of_a_steady_formation_stay() -> None:
    tree = tree_of(load(SCENARIOS / "triangle5.toml"))
    assert tree.offsets_at_m(np.array([0.0, 10.0])).shape == (4, 3)
