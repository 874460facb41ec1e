"""Every block of figures, and when it is compared with what is committed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from docs.generate import figures
from docs.generate.runner import Runner
from docs.generate.side_by_side import cluster, peers, tick_ratio
from docs.generate.stages import stages

Kind = Literal["quick", "exact", "slow", "timed", "compiled"]
"""Figures that are the same on every machine are `quick`, compared by the tests, `exact`, compared by CI, or `slow`,
compared only if they are named. `timed` ones are measured in real time; so are `compiled` ones, with the hot path
compiled.
"""


@dataclass(frozen=True)
class Figure:
    """A block of figures: how it is made, and how it may be compared."""

    make: Callable[[Runner], str]
    kind: Kind

    @property
    def exact(self) -> bool:
        return self.kind in ("quick", "exact", "slow")


_MAKERS: dict[Kind, tuple[Callable[[Runner], str], ...]] = {
    "quick": (figures.design, figures.margin_held, figures.margin_thesis, figures.readme_onset),
    "exact": (
        *(figures.onset_chain3, figures.string_limit, figures.compare, figures.prediction_windows),
        *(figures.prediction_price, figures.prediction_flights, figures.onsets, figures.thesis_flights),
        *(figures.maps, figures.capacity),
    ),
    "slow": (figures.copters_onset,),
    "timed": (
        *(figures.readme_fly, figures.flights, figures.too_late, figures.punctuality, figures.copters),
        *(figures.signing, figures.design_time, figures.speed, figures.onset_real_time, tick_ratio, peers, cluster),
        stages,
    ),
    "compiled": (figures.speed_compiled,),
}

FIGURES = {make.__name__.replace("_", "-"): Figure(make, kind) for kind, makers in _MAKERS.items() for make in makers}
"""Every block, by its name in the pages: that of its function."""
