"""Measure the figures of the documentation anew, or say which differ from what is committed."""

import sys
from collections.abc import Iterable

from docs.generate.blocks import differing, fill, pages_with
from docs.generate.figures import FIGURES
from docs.generate.runner import CommandError, measured_on, runner


def measured(name: str) -> str:
    """A block of figures: what the commands say, the commands, and where and when they ran."""
    figure = FIGURES[name]
    with runner() as run:
        text = figure.make(run)
        commands = "\n".join(run.commands)
    kind = "Exact: the same on every machine." if figure.exact else "Differs from run to run."
    return f"{text}\n\n```sh\n{commands}\n```\n\n{measured_on()}\n{kind}"


def measure(names: Iterable[str]) -> int:
    """Measure these and write them into the pages, each as soon as it is known; the number that failed."""
    failed = 0
    for name in names:
        print(f"{name} ...", flush=True)
        try:
            changed = fill({name: measured(name)})
        except CommandError as error:
            print(f"{name}: {error}", file=sys.stderr)
            failed += 1
        else:
            print(f"{name}: {', '.join(str(page) for page in changed) or 'as before'}", flush=True)
    return failed


def stale(names: Iterable[str]) -> list[str]:
    """Which of these figures the commands no longer give, with the pages that say otherwise."""
    found: list[str] = []
    for name in names:
        text = measured(name)
        found += [f"{page}: {name} differs; the commands give\n\n{text}\n" for page in differing(name, text)]
    return found


def unused() -> list[str]:
    """Figures that no page shows."""
    return [name for name in FIGURES if not pages_with(name)]
