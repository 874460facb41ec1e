"""Read a scenario file strictly, and write one.

ScenarioError(Exception)    the one error: file, key, what was read, what was wanted, in one line
"""

import difflib
import math
import tomllib
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from scenarios.schema import Scenario


class ScenarioError(Exception):
    """A scenario that cannot be flown."""

    def __init__(self, file: Path, key: str, read: object, wanted: str) -> None:
        shown = " ".join(repr(read).split())
        shown = shown if len(shown) <= 80 else shown[:77] + "..."
        super().__init__(f"{file}: {key}: read {shown}, wanted {wanted}")


def load(path: Path) -> Scenario:
    """The scenario in a TOML file, checked whole.

    Raises
    ------
    ScenarioError
        If the file cannot be read, a key is unknown, missing or of a wrong type, or the formation is not one tree.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(path, "file", str(error), "a readable TOML file") from None
    return parse(text, path)


def parse(text: str, file: Path) -> Scenario:
    """The scenario in a TOML text; `file` is named in errors."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(file, "file", str(error), "valid TOML") from None
    try:
        # TOML arrays become Python lists; strict validation from JSON text takes them as tuples.
        scenario = Scenario.model_validate_json(_json(data))
    except ValidationError as errors:
        raise _first_error(errors, data, file) from None
    for key, read, wanted in _contradictions(scenario):
        raise ScenarioError(file, key, read, wanted)
    return scenario


def dump(scenario: Scenario) -> str:
    """The scenario as TOML text that `parse` reads back to an equal object."""
    import tomlkit

    return tomlkit.dumps(scenario.model_dump(mode="json", exclude_none=True))


def _json(data: dict[str, Any]) -> str:
    import json

    return json.dumps(data, default=str)  # a TOML date becomes a string, which no key of the schema takes as a number


def _first_error(errors: ValidationError, data: dict[str, Any], file: Path) -> ScenarioError:
    """One line for the first of pydantic's findings."""
    found = errors.errors()
    first = next(
        (e for e in found if e["type"] == "extra_forbidden"), found[0]
    )  # a misspelt key explains a missing one
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    if first["type"] == "extra_forbidden":
        name = str(first["loc"][-1])
        known = sorted(_model_at(first["loc"][:-1]).model_fields)
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        wanted = f"the key {near[0]}" if near else f"one of the keys {', '.join(known)}"
        return ScenarioError(file, f"{key} (unknown key)", first["input"], wanted)
    if first["type"] == "missing":
        return ScenarioError(file, f"{key} (missing)", "nothing", "a value for this key")
    wanted = first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    wanted = (
        wanted.replace("a valid array", "an array").replace("a valid integer", "an integer").replace("a valid ", "a ")
    )
    return ScenarioError(file, key, _value_at(data, first["loc"]), wanted)


def _model_at(location: tuple[int | str, ...]) -> type[BaseModel]:
    """The schema's class at a place in the file."""
    model: type[BaseModel] = Scenario
    for part in location:
        if isinstance(part, str):
            annotation = model.model_fields[part].annotation
            model = next(iter(_models_in(annotation)))
    return model


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in getattr(annotation, "__args__", ()):
        yield from _models_in(argument)


def _value_at(data: Any, location: tuple[int | str, ...]) -> object:
    for part in location:
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            return data
    return data


def _contradictions(scenario: Scenario) -> Iterator[tuple[str, object, str]]:
    """What no single key can show: (key, what was read, what was wanted)."""
    yield from _formation_contradictions(scenario)
    yield from _velocity_contradictions(scenario)
    system_ids = [v.system_id for v in scenario.vehicles]
    own = [link.system_id for link in scenario.links.vehicles]
    for k, system_id in enumerate(own):
        if system_id not in system_ids:
            yield f"links.vehicles[{k}].system_id", system_id, "the system_id of a vehicle of this scenario"
        if system_id in own[:k]:
            yield f"links.vehicles[{k}].system_id", system_id, "one entry for each vehicle"
    control = scenario.control
    if control.gains is not None and (control.alpha is not None or control.delay_margin_s is not None):
        yield "control.gains", control.gains.model_dump(), "either gains or a requirement (alpha, delay_margin_s)"
    limits = scenario.limits
    if limits.speed_max_m_s is not None and limits.speed_max_m_s <= limits.speed_min_m_s:
        yield "limits.speed_max_m_s", limits.speed_max_m_s, f"more than speed_min_m_s = {limits.speed_min_m_s:g}"


def _formation_contradictions(scenario: Scenario) -> Iterator[tuple[str, object, str]]:
    vehicles = scenario.vehicles
    system_ids = [v.system_id for v in vehicles]
    leaders = [v.system_id for v in vehicles if v.follows is None]
    for k, vehicle in enumerate(vehicles):
        if vehicle.system_id in system_ids[:k]:
            yield f"vehicles[{k}].system_id", vehicle.system_id, "another number for each vehicle"
        if vehicle.follows is not None and vehicle.follows not in system_ids:
            yield f"vehicles[{k}].follows", vehicle.follows, "the system_id of a vehicle of this scenario"
        if (vehicle.follows is None) != (vehicle.offset_ne_m is None):
            wanted = "offset_ne_m with follows, and neither for the leader"
            yield f"vehicles[{k}].offset_ne_m", vehicle.offset_ne_m, wanted
        if vehicle.offset_ne_m == (0.0, 0.0):
            yield f"vehicles[{k}].offset_ne_m", vehicle.offset_ne_m, "a distance to the vehicle in front"
    try:
        TopologicalSorter({v.system_id: [] if v.follows is None else [v.follows] for v in vehicles}).prepare()
    except CycleError as error:
        cycle = " follows ".join(str(system_id) for system_id in reversed(error.args[1]))
        yield "vehicles.follows", f"a cycle: {cycle}", "a tree: every vehicle follows, in the end, the leader"
    if len(leaders) != 1:
        yield "vehicles.follows", f"vehicles without it: {leaders}", "exactly one vehicle without it, the leader"


def _velocity_contradictions(scenario: Scenario) -> Iterator[tuple[str, object, str]]:
    lowest, highest = scenario.limits.speed_min_m_s, scenario.limits.speed_max_m_s or math.inf
    wanted_speed = f"a speed within the limits, {lowest:g} to {highest:g} m/s"
    times = [entry.from_s for entry in scenario.nominal_velocity]
    for k, entry in enumerate(scenario.nominal_velocity):
        if (k == 0 and entry.from_s != 0) or (k > 0 and entry.from_s <= times[k - 1]):
            yield f"nominal_velocity[{k}].from_s", entry.from_s, "0 for the first entry, then increasing times"
        if not lowest <= math.hypot(*entry.velocity_ne_m_s) <= highest:
            yield f"nominal_velocity[{k}].velocity_ne_m_s", entry.velocity_ne_m_s, wanted_speed
    for k, vehicle in enumerate(scenario.vehicles):
        if not lowest <= math.hypot(*vehicle.velocity_ne_m_s) <= highest:
            yield f"vehicles[{k}].velocity_ne_m_s", vehicle.velocity_ne_m_s, wanted_speed
