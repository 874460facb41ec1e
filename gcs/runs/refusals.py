"""What does not get in at the station, by reason, for the log of a run: each once, so that no attacker can fill it."""

from collections import Counter
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

VEHICLES_FILE = "vehicles.json"
"""What the simulated vehicles counted."""

REFUSED = "refused"
"""Kind of the events: one when a reason is first met, and one at the end with how often each was."""
_IGNORED = {"other component", "before a first heartbeat"}
"""No strangers, though the station has no use for what they say."""
_COUNTERS = TypeAdapter(dict[str, int])


class Refusals:
    """Remembers what has been told."""

    def __init__(self) -> None:
        self._told: dict[str, int] = {}

    def news(self, counters: Counter[str], *, last: bool = False) -> dict[str, int]:
        """All counts by reason if there is a new reason, or at the end if any has changed; nothing otherwise."""
        if not last and counters.keys() <= self._told.keys() | _IGNORED:
            return {}
        counts = {reason: count for reason, count in counters.items() if reason not in _IGNORED}
        if counts == self._told:
            return {}
        self._told = counts
        return counts


def in_words(counts: dict[str, int]) -> str:
    """The counts in one line, the most frequent first."""
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items(), key=lambda each: -each[1]))


def counted_by_vehicles(folder: Path) -> dict[str, int] | None:
    """What the vehicles of a run counted; None if they have not said."""
    try:
        return _COUNTERS.validate_json((folder / VEHICLES_FILE).read_bytes())
    except (OSError, ValueError):
        return None


def refused_by_vehicles(folder: Path) -> dict[str, int] | None:
    """What they refused, by reason."""
    counters = counted_by_vehicles(folder)
    prefix = "refused_"
    return (
        None
        if counters is None
        else {
            name.removeprefix(prefix).replace("_", " "): count
            for name, count in counters.items()
            if name.startswith(prefix)
        }
    )


def counts_of(events: list[dict[str, Any]], kind: str = REFUSED) -> dict[str, int]:
    """The newest counts in a run's events of a kind."""
    told = [event["counts"] for event in events if event["kind"] == kind]
    return told[-1] if told else {}
