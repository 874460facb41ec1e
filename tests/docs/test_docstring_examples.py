"""The examples in the docstrings of `gains` run, and everything that a control engineer calls has one."""

import doctest
import inspect
import re
from collections.abc import Callable
from importlib import import_module
from pkgutil import walk_packages
from typing import Any

import pytest

import gains

MODULES = sorted(module.name for module in walk_packages(gains.__path__, "gains."))
PUBLIC_MODULES = [name for name in MODULES if "._" not in name]

# Functions of public modules that other modules of `gains` or gcs alone call. A new function is not among them and so
# needs an example.
INTERNAL_FUNCTIONS = {
    "gains.core.requirement.plain",
    "gains.core.structure.balanced",
    "gains.core.structure.real_matrix",
    "gains.core.structure.square_matrices",
    "gains.delay.several.crossing_curves",
    "gains.delay.sweep.sweep_frequencies",
    "gains.design.graph.assess",
    "gains.design.time_scale.scaled_to",
    "gains.formation.model.checked_gain",
    "gains.formation.pattern.check_fits",
    "gains.formation.pattern.checked_pattern_gain",
    "gains.margin.opinions.second_opinions",
    "gains.sampled.constant.checked_loop",
    "gains.sampled.coupled_block.critical_block",
    "gains.sampled.coupled_block.unlike_blocks",
    "gains.sampled.multirate.hardly_sampled",
    "gains.sampled.multirate.lifted_growth",
    "gains.sampled.multirate.lifted_margin",
    "gains.sampled.multirate.multirate_map",
}


def public(name: str, kind: Callable[[object], bool]) -> dict[str, Any]:
    """The public functions or classes that a module defines, by their full names."""
    module = import_module(name)
    members = inspect.getmembers(module, lambda member: kind(member) and member.__module__ == module.__name__)
    return {f"{name}.{member}": value for member, value in members if not member.startswith("_")}


def called_functions() -> dict[str, Any]:
    functions = {full: value for name in PUBLIC_MODULES for full, value in public(name, inspect.isfunction).items()}
    return {full: value for full, value in functions.items() if full not in INTERNAL_FUNCTIONS}


def classes_taken(functions: dict[str, Any]) -> dict[str, Any]:
    """The classes of `gains` whose objects some of the functions want as an argument."""
    parameters = (p for function in functions.values() for p in inspect.signature(function).parameters.values())
    named = set(re.findall(r"gains(?:\.\w+)+", " ".join(str(parameter.annotation) for parameter in parameters)))
    classes = {full: value for name in PUBLIC_MODULES for full, value in public(name, inspect.isclass).items()}
    return {full: value for full, value in classes.items() if full in named}


@pytest.mark.parametrize("name", ["gains", *MODULES])
def test_the_examples_of_a_module_run_in_an_empty_session(name: str) -> None:
    report: list[str] = []
    runner = doctest.DocTestRunner(verbose=False)
    for example in doctest.DocTestFinder().find(import_module(name), globs={}):
        runner.run(example, out=report.append)
    assert runner.failures == 0, "".join(report)


def test_every_function_that_is_called_and_every_class_it_takes_has_an_example() -> None:
    functions = called_functions()
    classes = classes_taken(functions)
    called = {"gains.delay.constant.analyse_delay", "gains.design.design.design"}
    taken = {"gains.formation.model.FormationModel", "gains.core.requirement.Requirement"}
    assert called <= functions.keys()
    assert taken <= classes.keys()
    without = [
        full
        for full, value in (functions | classes).items()
        if "Examples\n--------\n" not in (doc := inspect.getdoc(value) or "")
        or not doctest.DocTestParser().get_examples(doc)
    ]
    assert without == []


def test_what_is_called_internal_is_there() -> None:
    functions = {full for name in PUBLIC_MODULES for full in public(name, inspect.isfunction)}
    assert functions >= INTERNAL_FUNCTIONS
