"""The plots for scripts and notebooks show the numbers that the analyses give."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

from gains import analyse_delay
from gcs import plot_front, plot_growth, plot_root_locus
from gcs.errors import InputError
from gcs.plan.design import GainsAtDelay
from gcs.studies.front import FrontFields, picture
from gcs.views.page import figure_of

# stable for delays between 0.1002 and 1.7179 s only
LOOP = [[0.0, 1.0], [-2.0, 0.1]], [[0.0, 0.0], [1.0, 0.0]]
DELAYS_S = np.linspace(0.0, 3.0, 61).tolist()


def axes() -> Any:
    return figure_of(1, (6.0, 4.0))[1][0]


def test_growth_is_negative_exactly_in_the_shaded_windows() -> None:
    plot = plot_growth(*LOOP, DELAYS_S, axes())
    delay_s, growth_1_s = plot.lines[0].get_data()
    [window] = plot.patches
    inside = (delay_s > window.get_x()) & (delay_s < window.get_x() + window.get_width())
    assert np.array_equal(growth_1_s < 0.0, inside)
    assert plot.get_title() == "delay margin 0 s"


def test_root_locus_rings_the_crossings_of_the_axis() -> None:
    plot = plot_root_locus(*LOOP, DELAYS_S, axes(), roots=3)
    rings = plot.lines[0].get_data()[1]
    found = analyse_delay(*LOOP, horizon_s=3.0).crossings
    assert sorted(rings) == sorted(c.omega_rad_s for c in found if c.delay_s <= 3.0)
    real, imaginary = np.array(plot.collections[0].get_offsets()).T
    assert min(np.hypot(real, imaginary - rings[0])) < 0.05  # a delay of the grid is within 0.025 s of the crossing
    assert (imaginary >= 0.0).all()


def test_plots_without_axes_go_into_the_current_ones() -> None:
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure()
    assert plot_growth(*LOOP, [0.0, 0.5]).figure is figure
    plt.close(figure)


def test_front_has_a_line_for_each_route(tmp_path: Path) -> None:
    points = [
        GainsAtDelay(method="inclusion", prediction=on, maximised="alpha", loop_delay_s=at_s, alpha=1.0 / (1.0 + at_s))
        for on in (False, True)
        for at_s in (0.1, 0.3)
    ]
    found = FrontFields(scenario="chain3", tolerated=0.2, string_peak_max=1.0, points=tuple(points))
    plot = plot_front(found, "alpha", axes())
    assert [line.get_label() for line in plot.lines] == [
        "inclusion, not predicted, largest alpha",
        "inclusion, predicted, largest alpha",
    ]
    assert plot.lines[0].get_ydata().tolist() == [1.0 / 1.1, 1.0 / 1.3]
    with pytest.raises(InputError, match=r"figure: read 'beta', wanted one of alpha"):
        plot_front(found, "beta", axes())
    assert picture(found, tmp_path / "front.png").stat().st_size > 10_000
