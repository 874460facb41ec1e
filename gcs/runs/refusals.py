"""What the station and the vehicles refused, by reason. A reason is logged once, so no attacker can fill the log."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from pydantic import TypeAdapter

from gcs.control.tick import Event

VEHICLES_FILE = "vehicles.json"
"""The file with the counters of the simulated vehicles."""

REFUSED = "refused"
"""Kind of the events: one when a reason first occurs, and one at the end with the final count of each reason."""
_IGNORED = {"other component", "before a first heartbeat"}
"""Counters of frames that are harmless but of no use to the station, so not refusals."""
_COUNTERS = TypeAdapter(dict[str, int])


class Refusals:
    """Remembers which refusals have been reported."""

    def __init__(self) -> None:
        self._reported: dict[str, int] = {}

    def news(self, counters: Counter[str], *, last: bool = False) -> dict[str, int]:
        """All counts by reason if a reason is new, or with `last` if any count has changed; empty otherwise."""
        if not last and counters.keys() <= self._reported.keys() | _IGNORED:
            return {}
        counts = {reason: count for reason, count in counters.items() if reason not in _IGNORED}
        if counts == self._reported:
            return {}
        self._reported = counts
        return counts


def in_words(counts: dict[str, int]) -> str:
    """The counts in one line, the most frequent first."""
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items(), key=lambda each: -each[1]))


def counted_by_vehicles(folder: Path) -> dict[str, int] | None:
    """The counters of a run's vehicles; None if their file is missing or damaged."""
    try:
        return _COUNTERS.validate_json((folder / VEHICLES_FILE).read_bytes())
    except (OSError, ValueError):
        return None


def refused_by_vehicles(folder: Path) -> dict[str, int] | None:
    """How often a run's vehicles refused something, by reason; None if unknown."""
    counters, prefix = counted_by_vehicles(folder), "refused_"
    if counters is None:
        return None
    refused = {name.removeprefix(prefix): count for name, count in counters.items() if name.startswith(prefix)}
    return {name.replace("_", " "): count for name, count in refused.items()}


def counts_of(events: Sequence[Event], kind: str) -> dict[str, int]:
    """The counts of the last event of a kind that has any; empty if none has."""
    return next((event.counts for event in reversed(events) if event.kind == kind and event.counts is not None), {})
