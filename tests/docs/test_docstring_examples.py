"""The examples in the docstrings of `gains` run, and everything that a control engineer calls has one."""

import doctest
import inspect
import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import gains

MODULES = sorted(path.stem for path in Path(gains.__path__[0]).glob("*.py") if path.stem != "__init__")

# What other modules of `gains` alone call: whole modules, and functions of the others. A new function is not among
# them and so needs an example.
INTERNAL_MODULES = {
    "bracketing",
    "circle_angles",
    "crossing_error",
    "delay_crossings",
    "delay_curves",
    "delay_loci",
    "delay_zero",
    "sampled_crossings",
    "sampled_loop",
    "sampled_period",
    "submodular",
}
INTERNAL_FUNCTIONS = {
    "commensurate.block_crossings",
    "commensurate.column_space",
    "commensurate.companion_loci",
    "commensurate.has_fixed_root",
    "commensurate.highest_frequency",
    "delay.block_analysis",
    "delay.check_horizon",
    "delay.combined_analysis",
    "delay.stability_windows",
    "delay.unstable_roots",
    "delay_opinions.margin_error_s",
    "delay_opinions.second_opinions",
    "delay_sweep.near_unit_extrema",
    "delay_sweep.sweep_frequencies",
    "formation.checked_gain",
    "pattern.check_fits",
    "pattern.checked_pattern_gain",
    "requirement.plain",
    "robust.negative",
    "robust.solved",
    "sampled.checked_loop",
    "structure.balanced",
    "structure.real_matrix",
    "structure.square_matrices",
}


def public(name: str, kind: Callable[[object], bool]) -> dict[str, Any]:
    """The public functions or classes that a module of `gains` defines, by module.name."""
    module = import_module(f"gains.{name}")
    members = inspect.getmembers(module, lambda member: kind(member) and member.__module__ == module.__name__)
    return {f"{name}.{member}": value for member, value in members if not member.startswith("_")}


def called_functions() -> dict[str, Any]:
    names = [name for name in MODULES if name not in INTERNAL_MODULES]
    functions = {full: value for name in names for full, value in public(name, inspect.isfunction).items()}
    return {full: value for full, value in functions.items() if full not in INTERNAL_FUNCTIONS}


def classes_taken(functions: dict[str, Any]) -> dict[str, Any]:
    """The classes of `gains` whose objects some of the functions want as an argument."""
    parameters = (p for function in functions.values() for p in inspect.signature(function).parameters.values())
    named = set(re.findall(r"gains\.(\w+\.\w+)", " ".join(str(parameter.annotation) for parameter in parameters)))
    classes = {full: value for name in MODULES for full, value in public(name, inspect.isclass).items()}
    return {full: value for full, value in classes.items() if full in named}


@pytest.mark.parametrize("name", ["gains", *(f"gains.{name}" for name in MODULES)])
def test_the_examples_of_a_module_run_as_they_stand_in_an_empty_session(name: str) -> None:
    report: list[str] = []
    runner = doctest.DocTestRunner(verbose=False)
    for example in doctest.DocTestFinder().find(import_module(name), globs={}):
        runner.run(example, out=report.append)
    assert runner.failures == 0, "".join(report)


def test_every_function_that_is_called_and_every_class_it_takes_has_an_example() -> None:
    functions = called_functions()
    classes = classes_taken(functions)
    assert {"delay.analyse_delay", "design.design", "sampled.sampled_delay_margin"} <= functions.keys()
    assert {"formation.FormationModel", "pattern.Plant", "requirement.Requirement"} <= classes.keys()
    without = [
        full
        for full, value in (functions | classes).items()
        if "Examples\n--------\n" not in (doc := inspect.getdoc(value) or "")
        or not doctest.DocTestParser().get_examples(doc)
    ]
    assert without == []


def test_the_package_names_every_module_that_is_called() -> None:
    assert set(re.findall(r"`(\w+)`", gains.__doc__ or "")) == {*MODULES} - INTERNAL_MODULES


def test_what_is_called_internal_is_there() -> None:
    assert set(MODULES) >= INTERNAL_MODULES
    functions = {full for name in MODULES for full in public(name, inspect.isfunction)}
    assert functions >= INTERNAL_FUNCTIONS
