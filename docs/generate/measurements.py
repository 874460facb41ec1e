"""Measure the figures of the documentation anew, or say which differ from what is committed."""

import sys
from collections.abc import Iterable

from docs.generate.blocks import differing, fill, pages_with
from docs.generate.registry import FIGURES
from docs.generate.runner import CommandError, measured_on, runner

_EXACT = "Exact: computed, or flown in virtual time, and the same on every machine to the digits printed."
_VARIES = "Measured in real time: it differs from run to run and from machine to machine."


def measured(name: str) -> dict[str, str]:
    """The blocks of a figure: with its commands, machine and date, and `NAME-bare` without."""
    figure = FIGURES[name]
    with runner() as run:
        text = figure.make(run)
        commands = "\n".join(run.commands)
    whole = f"{text}\n\n```sh\n{commands}\n```\n\n{measured_on()}\n{_EXACT if figure.exact else _VARIES}"
    return {name: whole, f"{name}-bare": text}


def measure(names: Iterable[str]) -> int:
    """Measure these and write them into the pages, each as soon as it is known; the number that failed."""
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
    """Which of these figures the commands no longer give, with the pages that say otherwise."""
    found: list[str] = []
    for name in names:
        for block, text in measured(name).items():
            found += [f"{page}: {block} differs; the commands give\n\n{text}\n" for page in differing(block, text)]
    return found


def unused() -> list[str]:
    """Figures that no page shows."""
    return [name for name in FIGURES if not pages_with(name) + pages_with(f"{name}-bare")]
