"""Files that a scenario's links name: profiles, which ship or were written by --save-links, and traces of delays."""

import contextlib
import csv
import math
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import to_json

from scenarios.errors import InWords, ScenarioError, did_you_mean
from scenarios.keys.link import TRACE_DELAYS, Link, Links
from scenarios.keys.part import MOST
from scenarios.keys.profile import LinkProfile
from scenarios.schema import Scenario
from scenarios.shipped import PROFILES, names

TRACE_COLUMN = "delay_s"


def load_profile(name: str, beside: Path, key: str) -> LinkProfile:
    """The profile with a name, or in a file relative to the folder of the file `beside`, whose `key` names it.

    Raises ScenarioError if there is none, or if it cannot be read or is no profile.
    """
    shipped = names(PROFILES)
    path = PROFILES / f"{name}.toml" if name in shipped else beside.parent / name
    wanted = f"one of {', '.join(shipped)}, or a file that gcs monitor --save-links wrote"
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        return LinkProfile.model_validate_json(to_json(data))
    except FileNotFoundError:
        raise ScenarioError(beside, key, name, wanted + did_you_mean(name, shipped)) from None
    except OSError as error:
        raise ScenarioError(beside, key, InWords(f"{name!r}: {error.strerror}"), wanted) from None
    except ValidationError as errors:
        first = errors.errors()[0]
        at = ".".join(str(part) for part in first["loc"])
        raise ScenarioError(beside, key, InWords(f"{name!r}: {at}: {first['msg']}"), wanted) from None
    except (ValueError, RecursionError) as error:
        raise ScenarioError(beside, key, InWords(f"{name!r}: {error}"), wanted) from None


def dump_profile(profile: LinkProfile) -> str:
    """The profile as TOML text."""
    return toml_text(profile.model_dump(mode="json", exclude_none=True, exclude_defaults=True))


def toml_text(data: Mapping[str, Any]) -> str:
    """TOML text of tables, lists and values.

    tomlkit renumbers a list for each element that it appends, so lists of values, such as traces, are made whole.
    """
    import tomlkit
    from tomlkit.items import Array, Trivia, Whitespace

    def whole(part: Any) -> Any:
        if isinstance(part, dict):
            return {key: whole(value) for key, value in part.items()}
        if not isinstance(part, list):
            return part
        if not part or any(isinstance(value, (dict, list)) for value in part):
            return [whole(value) for value in part]
        items: list[Any] = [item for value in part for item in (Whitespace(", "), tomlkit.item(value))]
        return Array(items[1:], Trivia())

    return tomlkit.dumps(whole(data))


def each_link(links: Links) -> Iterator[tuple[str, Link]]:
    """Each link of the file with its key."""
    parts = ("links", links), *((f"links.vehicles[{k}]", own) for k, own in enumerate(links.vehicles))
    for key, part in parts:
        for name, link in (("up", part.up), ("down", part.down)):
            if link is not None:
                yield f"{key}.{name}", link


def with_traces(scenario: Scenario, file: Path) -> Scenario:
    """The scenario with delays in place of the names of trace files, so that it is complete without these files."""
    traces: dict[str, tuple[float, ...]] = {}
    for key, link in each_link(scenario.links):
        if link.jitter is not None and (name := link.jitter.trace_file) is not None:
            traces[name] = _read_trace(file.parent / name, file, f"{key}.jitter.trace_file")

    def read(link: Link) -> Link:
        if link.jitter is None or link.jitter.trace_file is None:
            return link
        update = {"trace_file": None, "trace_s": traces[link.jitter.trace_file]}
        return link.model_copy(update={"jitter": link.jitter.model_copy(update=update)})

    return scenario.with_links(read, read) if traces else scenario


def _read_trace(path: Path, file: Path, key: str) -> tuple[float, ...]:
    """The delays of a trace file, in s."""
    try:
        rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ScenarioError(
            file, key, InWords(error), "a readable file with a delay in s on each line, or CSV"
        ) from None
    cells = [cell.strip() for cell in rows[0]] if rows else []
    first = int(TRACE_COLUMN in cells)
    column = cells.index(TRACE_COLUMN) if first else 0
    delays: list[float] = []
    for number, row in enumerate(rows[first:], first + 1):
        if not row:
            continue
        delay_s = math.nan
        if first or len(row) == 1:
            with contextlib.suppress(ValueError, IndexError):
                delay_s = float(row[column])
        if not 0 <= delay_s <= MOST:
            wanted = f"a delay from 0 to {MOST:g} s on each line, or CSV with a column {TRACE_COLUMN}"
            raise ScenarioError(file, key, InWords(f"{','.join(row)!r} in line {number} of {path.name}"), wanted)
        delays.append(delay_s)
    if not 1 <= len(delays) <= TRACE_DELAYS:
        raise ScenarioError(file, key, InWords(f"{len(delays)} delays in {path.name}"), f"1 to {TRACE_DELAYS}")
    return tuple(delays)
