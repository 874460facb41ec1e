"""The keys of a scenario: the JSON Schema that editors check scenarios with, and its page in the reference."""

import ast
import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from docs.generate.blocks import ROOT, table
from scenarios.keys.part import Part
from scenarios.schema import Scenario

SCHEMA_FILE = ROOT / "scenarios" / "scenario.schema.json"
_UNITS = {  # by the end of the key's name, the longest first
    "_ne_m_s2": "m/s², north and east",
    "_ne_m_s": "m/s, north and east",
    "_ne_m": "m, north and east",
    "_rad_s": "rad/s",
    "_bit_s": "bit/s",
    "_m_s3": "m/s³",
    "_m_s2": "m/s²",
    "_bytes": "bytes",
    "_m_s": "m/s",
    "_1_s": "1/s",
    "_1_m": "1/m",
    "_ppm": "ppm",
    "_hz": "Hz",
    "_s2": "s²",
    "_m": "m",
    "_s": "s",
}
Node = dict[str, Any]


def schema() -> Node:
    """The JSON Schema of a scenario file. TOML has no null, so neither has a key that may be omitted."""
    made = Scenario.model_json_schema()
    for kind in _parts(Part):
        found = made if kind is Scenario else made["$defs"].get(kind.__name__, {})
        described = {name: text for each in reversed(kind.__mro__) for name, text in _docstrings(each).items()}
        for name, key in found.get("properties", {}).items():
            if name in described:
                found["properties"][name] = dict(sorted({**key, "description": described[name]}.items()))
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Scenario"} | _without_nulls(made)


def _parts(kind: type[Part]) -> Iterator[type[Part]]:
    yield kind
    for each in kind.__subclasses__():
        yield from _parts(each)


def _docstrings(kind: type) -> dict[str, str]:
    """The docstring below each key of a part."""
    if not issubclass(kind, Part):
        return {}
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    return {
        key.target.id: inspect.cleandoc(below.value.value)
        for key, below in pairwise(body.body)
        if isinstance(key, ast.AnnAssign) and isinstance(key.target, ast.Name)
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str)
    }


def schema_text() -> str:
    return json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"


def _without_nulls(node: Any) -> Any:
    if isinstance(node, list):
        return [_without_nulls(each) for each in node]
    if not isinstance(node, dict):
        return node
    kept = {key: _without_nulls(value) for key, value in node.items() if not (key == "default" and _is_empty(value))}
    if isinstance(kept.get("title"), str):
        del kept["title"]
    if "anyOf" in kept:
        choices = [choice for choice in kept.pop("anyOf") if choice != {"type": "null"}]
        kept |= choices[0] if len(choices) == 1 else {"anyOf": choices}
    return kept


def _is_empty(default: Any) -> bool:
    """Whether a default is that of a part, whose own keys have theirs, or of a key that is simply omitted."""
    return default is None or isinstance(default, dict)


def keys_page() -> str:
    """A section for the scenario and one for each kind of table in it, which may occur in several places."""
    whole = schema()
    places: dict[str, list[str]] = {"": ["The scenario"]}
    _find_places(whole, whole, "", places)
    return "\n\n".join(_section(whole, whole["$defs"].get(kind, whole), headers) for kind, headers in places.items())


def _find_places(whole: Node, part: Node, name: str, places: dict[str, list[str]]) -> None:
    """Collect the headers of each kind of table, in the order of the keys."""
    for key, given in part["properties"].items():
        kind, what = _kind(given)
        if kind:
            path = f"{name}.{key}" if name else key
            places.setdefault(kind, []).append(f"`[[{path}]]`" if what == "array" else f"`[{path}]`")
            _find_places(whole, whole["$defs"][kind], path, places)


def _section(whole: Node, part: Node, headers: list[str]) -> str:
    required = set(part.get("required", ()))
    rows: list[tuple[str, ...]] = []
    for key, given in part["properties"].items():
        node, what = _resolved(whole, given)
        cells = _unit(key), _values(node, what), _default(given, node, required=key in required), _bounds(node, what)
        rows.append((f"`{key}`", *cells, " ".join(given.get("description", "").split())))
    also = f"Also in {', '.join(headers[1:])}.\n\n" if headers[1:] else ""
    head = ("key", "unit", "value", "default", "bounds", "meaning")
    return f"## {headers[0]}\n\n{also}{_paragraphs(part.get('description', ''))}\n\n{table(head, rows)}"


def _paragraphs(text: str) -> str:
    """A docstring as Markdown; text laid out in columns becomes a code block."""
    return "\n\n".join(
        f"```text\n{paragraph}\n```" if re.search(r"\S {2,}\S", paragraph) else paragraph
        for paragraph in text.split("\n\n")
    )


def _kind(node: Node) -> tuple[str, str]:
    """The name of the definition behind a key, or nothing, and whether the key holds one of it or an array."""
    if "$ref" in node.get("items", {}):
        return _kind(node["items"])[0], "array"
    return node.get("$ref", "").rsplit("/", 1)[-1], "one"


def _resolved(whole: Node, node: Node) -> tuple[Node, str]:
    """What describes the value of a key, and whether that is one table or value, or an array of tables."""
    kind, what = _kind(node)
    bounds = {name: node[name] for name in ("minItems", "maxItems") if name in node}
    return (whole["$defs"][kind] | bounds if kind else node), what


def _unit(key: str) -> str:
    return next((unit for end, unit in _UNITS.items() if key.endswith(end)), "")


def _values(node: Node, what: str) -> str:
    if "anyOf" in node:
        return " or ".join(_values(choice, what) for choice in node["anyOf"])
    if "enum" in node:
        return ", ".join(f"`{choice}`" for choice in node["enum"])
    if "properties" in node:
        return "tables" if what == "array" else "table"
    if node["type"] == "array":
        inner = node.get("items") or node["prefixItems"][0]
        count = node.get("minItems") if "prefixItems" in node else None
        if inner["type"] == "array":
            return f"{f'{count} ' if count else ''}rows of {_values(inner, 'one').removeprefix('list of ')}"
        return f"{count or 'list of'} {_values(inner, 'one')}s"
    return {"number": "number", "integer": "whole number", "boolean": "true, false", "string": "text"}[node["type"]]


def _default(given: Node, node: Node, *, required: bool) -> str:
    if required:
        return "*required*"
    if "default" not in given or "properties" in node:
        return ""
    return f"`{json.dumps(given['default'])}`"


_PATTERNS = {
    r"^[A-Za-z0-9_-]+$": "letters, digits, `_` and `-`",
    r"^[^:]+\.py:[A-Za-z_][A-Za-z0-9_]*$": "FILE.py:NAME",
    r"^jsbsim(:[A-Za-z0-9_-]+)?$": "jsbsim or jsbsim:MODEL",
    r"^[0-9a-f]{64}$": "64 hexadecimal digits",
}
"""Each pattern of the schema, in words."""


def _bounds(node: Node, what: str) -> str:
    if what == "array":
        least, most = node.get("minItems", 0), node.get("maxItems")
        return f"{least} to {most}" if most else f"at least {least}" if least else ""
    if node.get("type") == "array":
        inner = node.get("items") or node["prefixItems"][0]
        return _bounds(inner, "one")
    found = [bounds for choice in node.get("anyOf", ()) if (bounds := _bounds(choice, what))]
    for name, sign in (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤")):
        if name in node:
            found.append(f"{sign} {_number(node[name])}")
    if "pattern" in node:
        found.append(_PATTERNS[node["pattern"]])
    return ", ".join(found)


def _number(value: float) -> str:
    return f"{value:,.12g}" if abs(value) < 1e15 else "2⁶³"
