"""The examples in the docstrings of `gains` run, and every function that a user or another package calls has one."""

import doctest
import inspect
import re
from collections.abc import Callable
from importlib import import_module
from pkgutil import walk_packages
from typing import Any

import pytest

import gains
from docs.generate.api import documented

MODULES = sorted(module.name for module in walk_packages(gains.__path__, "gains."))
PUBLIC_MODULES = [name for name in MODULES if "._" not in name]

# Functions of public modules that only other modules of `gains` or gcs call. Instead of examples they have tests with
# known answers. A function that is not listed here needs an example.
INTERNAL_FUNCTIONS = {
    "gains.core.arrays.least_singular_values",
    "gains.core.arrays.matrix_exponentials",
    "gains.core.arrays.spectral_norms",
    "gains.core.requirement.plain",
    "gains.core.semidefinite.negative",
    "gains.core.semidefinite.positive_definite_solution",
    "gains.core.semidefinite.solved",
    "gains.core.structure.balanced",
    "gains.core.structure.block_diagonal",
    "gains.core.structure.distinct_blocks",
    "gains.core.structure.is_singular_for_any_delay",
    "gains.core.structure.positive_number",
    "gains.core.structure.positive_seconds",
    "gains.core.structure.real_matrix",
    "gains.core.structure.seconds",
    "gains.core.structure.square_matrices",
    "gains.core.structure.without_fixed_roots",
    "gains.criteria.parts.parts_of",
    "gains.criteria.parts.rounded",
    "gains.delay.several.crossing_curves",
    "gains.delay.sweep.circle_sweep_margin",
    "gains.design.dk_iteration.decay_proof",
    "gains.design.for_delay.searched",
    "gains.design.front.efficient",
    "gains.design.graph.assess",
    "gains.design.graph.graph_design",
    "gains.design.graph.lqr_bases",
    "gains.design.required.required_gains",
    "gains.design.search.fastest_decay",
    "gains.design.search.largest_alpha",
    "gains.design.search.largest_margin",
    "gains.design.structured_lqr.stabilising_gain",
    "gains.design.structured_lqr.structured_lqr",
    "gains.design.time_scale.scaled_to",
    "gains.formation.bipartite.smallest_partition",
    "gains.formation.fixed_modes.check_stabilisable",
    "gains.formation.model.checked_gains",
    "gains.formation.pattern.check_fits",
    "gains.formation.pattern.checked_pattern_gain",
    "gains.margin.loop_margin.fixed_note",
    "gains.margin.model_file.with_short_zeros",
    "gains.margin.opinions.second_opinions",
    "gains.performance.behaviour.block_margin",
    "gains.performance.behaviour.diagonal_blocks",
    "gains.performance.robust.certify",
    "gains.performance.robust.subsystem_loop",
    "gains.performance.scalar_gains.alpha_of",
    "gains.performance.scalar_gains.decay_rate_of",
    "gains.performance.scalar_gains.front_gain_range",
    "gains.performance.scalar_gains.gains_of_margin",
    "gains.performance.scalar_gains.least_singular_value",
    "gains.performance.scalar_gains.onboard_front_gain_limit",
    "gains.sampled.constant.checked_loop",
    "gains.sampled.constant.spectral_radius",
    "gains.sampled.coupled_block.critical_block",
    "gains.sampled.coupled_block.first_of_each_kind",
    "gains.sampled.multirate.first_unstable",
    "gains.sampled.multirate.is_nearly_continuous",
    "gains.sampled.multirate.lifted_growth",
    "gains.sampled.multirate.lifted_margin",
    "gains.sampled.multirate.lifted_radius",
    "gains.sampled.multirate.multirate_map",
    "gains.sampled.onboard.local_plant",
    "gains.sampled.prediction.checked_mask",
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
    """The classes of `gains` that the functions take as arguments."""
    parameters = (p for function in functions.values() for p in inspect.signature(function).parameters.values())
    named = set(re.findall(r"gains(?:\.\w+)+", " ".join(str(parameter.annotation) for parameter in parameters)))
    classes = {full: value for name in PUBLIC_MODULES for full, value in public(name, inspect.isclass).items()}
    return {full: value for full, value in classes.items() if full in named}


def failures(test: doctest.DocTest) -> list[str]:
    report: list[str] = []
    runner = doctest.DocTestRunner(verbose=False)
    runner.run(test, out=report.append)
    return report if runner.failures else []


@pytest.mark.parametrize("name", ["gains", *(name for name in MODULES if name not in PUBLIC_MODULES)])
def test_the_examples_of_internal_modules_run_in_their_namespace(name: str) -> None:
    for test in doctest.DocTestFinder().find(import_module(name)):
        assert failures(test) == []


@pytest.mark.parametrize("name", PUBLIC_MODULES)
def test_reference_page_examples_run_in_an_empty_session(name: str) -> None:
    texts = documented(import_module(name))
    for full, text in texts.items():
        assert failures(doctest.DocTestParser().get_doctest(text, {}, f"{name}.{full}", None, None)) == []
    found = doctest.DocTestFinder(exclude_empty=True).find(import_module(name))
    assert {test.name.removeprefix(f"{name}.") for test in found if test.examples} <= texts.keys()


def test_called_functions_and_their_argument_classes_have_examples() -> None:
    functions = called_functions()
    classes = classes_taken(functions)
    called = {"gains.delay.constant.analyse_delay", "gains.design.design.design"}
    taken = {"gains.formation.model.FormationModel", "gains.core.requirement.Requirement"}
    assert called <= functions.keys()
    assert taken <= classes.keys()
    everything = functions | classes
    examples = {full: doctest.DocTestParser().get_examples(inspect.getdoc(v) or "") for full, v in everything.items()}
    assert [full for full in functions if not examples[full]] == []
    # an example makes each class, or a function with an example returns it
    made = "".join(example.source + example.want for own in examples.values() for example in own)
    made += " ".join(f"{inspect.signature(function).return_annotation}(" for function in functions.values())
    assert [full for full in classes if f"{full.split('.')[-1]}(" not in made and full not in made] == []


def test_listed_internal_functions_exist() -> None:
    functions = {full for name in PUBLIC_MODULES for full in public(name, inspect.isfunction)}
    assert functions >= INTERNAL_FUNCTIONS
