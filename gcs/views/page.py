"""Self-contained HTML pages: templates of this package with embedded figures, which matplotlib draws."""

import base64
from functools import partial
from pathlib import Path
from typing import Any

from gcs.views.console import ms_text, number_text

_DPI = 130


def rendered(template: str, **values: Any) -> str:
    """Render a template of this package, with the filters `ms` and `number`."""
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=PackageLoader("gcs.views", "."), autoescape=select_autoescape(["j2"]), undefined=StrictUndefined
    )
    environment.filters |= {"ms": partial(ms_text, form=".2f"), "number": number_text}
    return environment.get_template(template).render(**values)


def data_uri(png: Path) -> str:
    """A picture embedded in a data URI."""
    return "data:image/png;base64," + base64.b64encode(png.read_bytes()).decode("ascii")


def figure_of(
    rows: int, size: tuple[float, float], heights: tuple[float, ...] = (1.0,), *, columns: int = 1
) -> tuple[Any, Any]:
    """A figure that needs no screen, and its plots from the top: (rows,), or (rows, columns) with several columns."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    plots = figure.subplots(rows, columns, squeeze=False, height_ratios=heights)
    for plot in plots.flat:
        plot.grid(visible=True, color="#dddddd", linewidth=0.6)
        plot.spines[["top", "right"]].set_visible(False)
        plot.set_axisbelow(True)
    return figure, plots if columns > 1 else plots[:, 0]


def saved(figure: Any, file: Path) -> Path:
    figure.savefig(file, dpi=_DPI)
    return file
