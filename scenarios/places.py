"""Wording of errors in a scenario file: the line of a key, and what its value must be, in plain words."""

import itertools
import re
from collections import Counter
from collections.abc import Mapping
from typing import Any

Location = tuple[int | str, ...]
_HEADER = re.compile(r"\s*(\[\[?)\s*([\w.\s-]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*([\w-]+(?:\s*\.\s*[\w-]+)*)\s*=")
_OF_VEHICLE = re.compile(r"vehicle (\d+): (.*)")
_PART = re.compile(r"([\w-]+)|\[(\d+)\]")


def location_of(key: str) -> Location:
    """The location that a key such as "vehicles[1].follows" names."""
    return tuple(name or int(number) for name, number in _PART.findall(key))


def place_of(key: str, text: str, data: Mapping[str, Any]) -> str:
    """The line of a key in a TOML text, if it has one, and its name: "line 9: vehicle 2: follows".

    The key is one such as "vehicles[1].follows", or names the vehicle already, which need not be in the text.
    """
    if of_vehicle := _OF_VEHICLE.fullmatch(key):
        ids = [vehicle["system_id"] for vehicle in data["vehicles"]]
        if int(of_vehicle[1]) not in ids:
            return key
        key = f"vehicles[{ids.index(int(of_vehicle[1]))}].{of_vehicle[2]}"
    line = line_of(text, location_of(key))
    return named(key, data) if line is None else f"line {line}: {named(key, data)}"


def line_of(text: str, location: Location) -> int | None:
    """The line, counted from 1, of a location in a TOML text; None if there is none.

    A location without a line of its own has that of its first part, or else that of the part around it.
    """
    lines: dict[Location, int] = {}
    tables: Counter[Location] = Counter()
    table: Location = ()
    key: Location = ()
    entries = 0
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            table = ()
            *outer, last = re.split(r"\s*\.\s*", header[2])
            for name in outer:
                table = (*table, name)
                if tables[table]:
                    table = (*table, tables[table] - 1)
            table = (*table, last)
            if header[1] == "[[":
                tables[table] += 1
                table = (*table, tables[table] - 1)
            lines.setdefault(table, number)
            continue
        if found := _KEY.match(line):
            key, entries = (*table, *re.split(r"\s*\.\s*", found[1])), 0
            lines.setdefault(key, number)
        if found or line.lstrip().startswith("{"):  # a list of tables may have each on a line of its own
            for _ in range(_outer_tables(line)):
                lines.setdefault((*key, entries), number)
                entries += 1
    for k in range(len(location), 0, -1):
        if found := [line for at, line in lines.items() if at[:k] == location[:k]]:
            return lines.get(location[:k], min(found))
    return None


def _outer_tables(line: str) -> int:
    """Number of inline tables that begin on a line and are in no other."""
    depths = itertools.accumulate((char == "{") - (char == "}") for char in line)
    return sum(char == "{" and depth == 1 for char, depth in zip(line, depths, strict=True))


def named(key: str, data: Mapping[str, Any]) -> str:
    """A key with a vehicle's system id in place of its index: "vehicle 2: follows" for "vehicles[1].follows"."""
    match location_of(key):
        case ("vehicles", int(k), *_):
            kind, whole = "vehicle", data.get("vehicles")
        case ("links", "vehicles", int(k), *_):
            links = data.get("links")
            kind, whole = "links of vehicle", links.get("vehicles") if isinstance(links, dict) else None
        case _:
            return key
    ids = [one.get("system_id") if isinstance(one, dict) else None for one in whole] if isinstance(whole, list) else []
    alone = k < len(ids) and type(ids[k]) is int and ids.count(ids[k]) == 1
    rest = key.split("]", 1)[1].lstrip(".")
    return f"{kind} {ids[k]}: {rest}" if alone else f"{kind} in place {k + 1}: {rest}"


_WANTED = {
    "int_type": "an integer",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "string_type": "text in quotes",
    "string_pattern_mismatch": "a name of letters, digits, - and _",
    "literal_error": "{expected}",
    "greater_than": "a number greater than {gt:.10g}",
    "greater_than_equal": "a number of at least {ge:.10g}",
    "less_than": "a number less than {lt:.10g}",
    "less_than_equal": "a number of at most {le:.10g}",
    "too_short": "a list of at least {min_length}, not {actual_length}",
    "too_long": "a list of at most {max_length}, not {actual_length}",
    "tuple_type": "a list in brackets",
    "model_type": "a table of keys",
    "system_id": "at most 250, or 1001 to 1250 in network 1, 2001 to 2250 in network 2, and so on",
    "dynamics": "double_integrator, autopilot, jsbsim, jsbsim:MODEL, or FILE.py:NAME",
    "prediction": "off, measured, or a number of seconds greater than 0, at most {most:g}",
}
"""Wording of what was wanted, by the type of pydantic's error."""


def wanted_of(error: Mapping[str, Any]) -> str:
    """What was wanted at one of pydantic's errors, in plain words."""
    context = error.get("ctx", {})
    if ".py:" in str(context.get("pattern", "")).replace("\\", ""):
        return "FILE.py:NAME"
    return _WANTED[error["type"]].format(**context)
