"""The search for the nearest vehicles, which does not look at all pairs, against one that does."""

from math import inf, nan, sqrt

import numpy as np
import pytest

from gcs.control.law import CONTROL, nearest

NOW_NS = 1_000_000_000


def of_all_pairs(controls: np.ndarray, down_m: np.ndarray | None) -> tuple[list[float], tuple[int, int]]:
    age_s = (NOW_NS - controls["sample_ns"]) * 1e-9
    places = controls["state"][:, :2] + controls["state"][:, 2:] * age_s[:, np.newaxis]
    near, least, two = [inf] * len(places), inf, (0, 0)
    for row in range(len(places)):
        for other in range(row + 1, len(places)):
            north, east = (places[row] - places[other]).tolist()
            square = north * north + east * east
            if down_m is not None:
                square = sqrt(square) ** 2 + (down_m[row] - down_m[other]) ** 2
            if square < least:
                least, two = square, (row, other)
            near[row], near[other] = min(near[row], square), min(near[other], square)
    return [sqrt(one) if one < inf else nan for one in near], two


@pytest.mark.parametrize("slots", [False, True])
@pytest.mark.parametrize("on_a_grid", [False, True])
def test_the_nearest_are_those_among_all_pairs(on_a_grid: bool, slots: bool) -> None:
    """On a grid many pairs are equally near, and the first of them counts; some positions are not known."""
    rng = np.random.default_rng(5)
    for vehicles in rng.integers(1, 30, 200).tolist():
        controls = np.zeros(vehicles, CONTROL)
        controls["sample_ns"] = NOW_NS if on_a_grid else rng.integers(0, NOW_NS, vehicles)
        scattered = rng.normal(size=(vehicles, 4)) * [300.0, 40.0, 5.0, 5.0]
        controls["state"] = rng.integers(-4, 5, (vehicles, 4)) * 100.0 if on_a_grid else scattered
        controls["state"][rng.random(vehicles) < 0.1] = nan
        down_m = rng.integers(0, 3, vehicles) * 100.0 if slots else None
        found = nearest(controls, NOW_NS, np.empty(0) if down_m is None else down_m)
        distance_m, two = of_all_pairs(controls, down_m)
        np.testing.assert_allclose(found.distance_m, distance_m, rtol=1e-15)
        assert tuple(found.two) == two
