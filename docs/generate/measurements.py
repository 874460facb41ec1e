"""Lists every block of figures; measures them again, or reports which differ from what is committed."""

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

from docs.generate import figures
from docs.generate.blocks import differing, fill, pages_with
from docs.generate.certificates import certificates
from docs.generate.runner import CommandError, Runner, measured_on, runner
from docs.generate.side_by_side import cluster, peers, tick_ratio
from docs.generate.stages import stages

Kind = Literal["quick", "exact", "slow", "timed"]
"""Figures that are the same on every machine are `quick`, compared by the tests, `exact`, compared by CI, or `slow`,
compared only if they are named. `timed` ones are measured in real time.
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
        *(figures.string_limit, figures.compare, figures.prediction_windows),
        figures.prediction_price,
    ),
    "slow": (
        *(figures.onsets, figures.one_link, figures.maps, figures.capacity, figures.copters_onset),
        *(figures.onset_chain3, figures.prediction_flights, figures.thesis_flights),  # tests make similar flights
    ),
    "timed": (
        *(figures.readme_fly, figures.flights, figures.too_late, figures.punctuality, figures.copters),
        *(figures.signing, figures.design_time, figures.speed, figures.map_speed, figures.onset_real_time),
        *(tick_ratio, peers, cluster, stages, certificates),
    ),
}

FIGURES = {make.__name__.replace("_", "-"): Figure(make, kind) for kind, makers in _MAKERS.items() for make in makers}
"""Every block by its name in the pages, which is that of its function with hyphens."""

_EXACT = "Exact: computed, or flown in virtual time, and the same on every machine to the digits printed."
_VARIES = "Measured in real time: it differs from run to run and from machine to machine."


def measured(name: str) -> dict[str, str]:
    """Both blocks of a figure: `NAME` with commands, machine and date, and `NAME-bare` without."""
    figure = FIGURES[name]
    with runner() as run:
        text = figure.make(run)
        commands = "\n".join(run.commands)
    whole = f"{text}\n\n```sh\n{commands}\n```\n\n{measured_on()}\n{_EXACT if figure.exact else _VARIES}"
    return {name: whole, f"{name}-bare": text}


def measure(names: Iterable[str]) -> int:
    """Measure these and write each into its pages at once; return how many failed."""
    failed = 0
    for name in names:
        print(f"{name} ...", flush=True)
        try:
            changed = fill(measured(name))
        except CommandError as error:
            print(f"{name}: {error}", file=sys.stderr)
            failed += 1
        else:
            print(f"{name}: {', '.join(str(page) for page in changed) or 'as before'}", flush=True)
    return failed


def stale(names: Iterable[str]) -> list[str]:
    """For each figure that its commands no longer give: the page, the block and what they give now."""
    found: list[str] = []
    for name in names:
        for block, text in measured(name).items():
            found += [f"{page}: {block} differs; the commands give\n\n{text}\n" for page in differing(block, text)]
    return found


def unused() -> list[str]:
    """Figures that no page shows."""
    return [name for name in FIGURES if not pages_with(name) + pages_with(f"{name}-bare")]
