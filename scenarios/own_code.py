"""Files of Python code that a scenario names: read with it, written beside it, and run only if the user allows it.

A scenario holds the text of its code, so that it is complete without the files: in another process, on another machine,
and in the folder of its run. `function_of` is the only place that runs it.
"""

import linecache
import sys
from collections.abc import Iterator
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import Any

from scenarios.errors import InWords, ScenarioError
from scenarios.keys.own import BUILT_IN, CodeFile, names_code
from scenarios.keys.part import Fault
from scenarios.schema import Scenario

LARGEST_BYTES = 1_000_000
"""Largest file of code."""
ALLOW = "--allow-code"
"""The option with which a user allows a command to run the code that a scenario names."""


def code_names(scenario: Scenario) -> dict[str, str]:
    """The code that a scenario names, FILE.py:NAME by key."""
    control = scenario.control
    named = {
        "control.controller": control.controller,
        "control.linear": control.linear,
        "dynamics": scenario.dynamics if names_code(scenario.dynamics) else None,
    }
    return {key: name for key, name in named.items() if name is not None}


def own_code_faults(scenario: Scenario) -> Iterator[Fault]:
    """Contradictions in the keys of the user's own controller or dynamics."""
    control, own_law = scenario.control, scenario.control.method == "python"
    own_dynamics = scenario.dynamics not in BUILT_IN
    if own_law != (control.controller is not None):
        wanted = "FILE.py:NAME, with method python" if own_law else "no such key, unless method is python"
        yield "control.controller", control.controller, wanted
    if control.linear is not None and not own_law:
        yield "control.linear", control.linear, "no such key, unless method is python"
    if own_law:
        for name in ("gains", "blocks", "delay_margin_s", "alpha", "decay_rate_1_s", "criteria", "overlap"):
            if getattr(control, name):
                yield f"control.{name}", InWords(name), "no such key with method python, which designs nothing"
        if control.prediction != "off":
            yield "control.prediction", control.prediction, "off, with method python"
        if any(vehicle.hears for vehicle in scenario.vehicles):
            yield "vehicles.hears", InWords("system ids"), "no such key with method python: the law knows every vehicle"
    if control.loop == "onboard" and (own_law or own_dynamics):
        key = "method python" if own_law else f"dynamics {scenario.dynamics}"
        yield "control.loop", control.loop, f"ground, with {key}"
    if names_code(scenario.dynamics) and scenario.response is not None and scenario.response.velocity_gain_1_s:
        wanted = "0, with dynamics of your own: set-points carry accelerations only"
        yield "response.velocity_gain_1_s", scenario.response.velocity_gain_1_s, wanted


def with_code(scenario: Scenario, file: Path) -> Scenario:
    """The scenario with the text of the code that it names; nothing is run."""
    files: dict[str, CodeFile] = {}
    for key, name in code_names(scenario).items():
        path = name.rpartition(":")[0]
        if path not in files:
            files[path] = CodeFile(name=path, text=_read(path, file, key))
    return scenario.model_copy(update={"code": tuple(files.values())}) if files else scenario


def _read(name: str, file: Path, key: str) -> str:
    path = file.parent / name
    wanted = f"a readable Python file of at most {LARGEST_BYTES} bytes"
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise ScenarioError(file, key, InWords(f"{name!r}: {path.stat().st_size} bytes"), wanted)
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        read = error.strerror if isinstance(error, OSError) else "bytes that are not UTF-8"
        raise ScenarioError(file, key, InWords(f"{name!r}: {read}"), wanted) from None


def as_flown(scenario: Scenario) -> Scenario:
    """The scenario with its code renamed to files in its own folder, as `write_code` writes them."""
    if not scenario.code:
        return scenario
    here = {code.name: Path(code.name).name for code in scenario.code}
    if len(set(here.values())) < len(here):  # files of one name from two folders
        here = {code.name: f"{k}_{Path(code.name).name}" for k, code in enumerate(scenario.code, 1)}
    moved = {
        key: f"{here[name.rpartition(':')[0]]}:{name.rpartition(':')[2]}" for key, name in code_names(scenario).items()
    }
    control = scenario.control.model_copy(
        update={key.removeprefix("control."): name for key, name in moved.items() if key.startswith("control.")}
    )
    code = tuple(one.model_copy(update={"name": here[one.name]}) for one in scenario.code)
    return scenario.model_copy(
        update={"control": control, "dynamics": moved.get("dynamics", scenario.dynamics), "code": code}
    )


def write_code(scenario: Scenario, folder: Path) -> None:
    """Write the files of code that a scenario names into the folder of its scenario.toml."""
    for code in as_flown(scenario).code:
        (folder / code.name).write_text(code.text, encoding="utf-8")


def refusal(scenario: Scenario, file: Path, where: str = "") -> str | None:
    """Why a command that was not allowed to run code cannot use the scenario; None if it names none."""
    named = code_names(scenario)
    if not named:
        return None
    key, name = next(iter(named.items()))
    wanted = (
        where or f"{ALLOW} to run the code in {', '.join(sorted({each.rpartition(':')[0] for each in named.values()}))}"
    )
    return f"{file}: {key}: read {name!r}, wanted {wanted}"


def function_of(scenario: Scenario, key: str) -> Any:
    """The function that a key of the scenario names. This runs the file.

    Raises ScenarioError if the file raises an exception or has no such function.
    """
    name = code_names(scenario)[key]
    path, _, wanted = name.rpartition(":")
    [code] = [code for code in scenario.code if code.name == path]
    try:
        module = _module(code.name, code.text)
    except BaseException as error:  # whatever the user's file raises, SystemExit included
        if isinstance(error, KeyboardInterrupt):
            raise
        read = f"{type(error).__name__}: {error}"
        raise ScenarioError(Path(path), key, InWords(read), "a file that runs without an exception") from error
    if not callable(found := getattr(module, wanted, None)):
        raise ScenarioError(Path(path), key, wanted, "the name of a function in this file")
    return found


@lru_cache(maxsize=16)
def _module(name: str, text: str) -> ModuleType:
    """The module made by running the text of a file."""
    module = ModuleType(f"own_code_{sha256(text.encode()).hexdigest()[:16]}")
    module.__file__ = name
    sys.modules[module.__name__] = module  # dataclasses look their module up
    linecache.cache[name] = len(text), None, text.splitlines(keepends=True), name  # for tracebacks
    try:
        exec(compile(text, name, "exec"), module.__dict__)
    except BaseException:
        del sys.modules[module.__name__]
        raise
    return module
