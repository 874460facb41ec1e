"""For errors in a scenario file: the line of a key, and what its value must be, in plain words."""

import re
from collections import Counter
from collections.abc import Mapping
from typing import Any

Location = tuple[int | str, ...]
_HEADER = re.compile(r"\s*(\[\[?)\s*([\w.\s-]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*([\w-]+(?:\s*\.\s*[\w-]+)*)\s*=")
_PART = re.compile(r"([\w-]+)|\[(\d+)\]")


def location_of(key: str) -> Location:
    """The location that a key such as "vehicles[1].follows" names."""
    return tuple(name or int(number) for name, number in _PART.findall(key))


def line_of(text: str, location: Location) -> int | None:
    """The line of a TOML text, from 1, of a location, or of the part around it if it has no line of its own."""
    lines: dict[Location, int] = {}
    tables: Counter[Location] = Counter()
    table: Location = ()
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
        elif found := _KEY.match(line):
            lines.setdefault((*table, *re.split(r"\s*\.\s*", found[1])), number)
    return next((lines[location[:k]] for k in range(len(location), 0, -1) if location[:k] in lines), None)


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
    "int_from_float": "an integer",
    "int_parsing": "an integer",
    "int_parsing_size": "an integer of fewer digits",
    "float_type": "a number",
    "float_parsing": "a number",
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
    "model_attributes_type": "a table of keys",
    "dict_type": "a table of keys",
    "system_id": "at most 250, or 1001 to 1250 in network 1, 2001 to 2250 in network 2, and so on",
    "dynamics": "double_integrator, autopilot, jsbsim, jsbsim:MODEL, or FILE.py:NAME",
    "prediction": "off, measured, or a number of seconds greater than 0, at most {most:g}",
}
"""What was wanted, by the type of pydantic's error."""


def wanted_of(error: Mapping[str, Any]) -> str:
    """What was wanted at one of pydantic's errors, in plain words."""
    context = error.get("ctx", {})
    if ".py:" in str(context.get("pattern", "")).replace("\\", ""):
        return "FILE.py:NAME"
    return _WANTED[error["type"]].format(**context)
