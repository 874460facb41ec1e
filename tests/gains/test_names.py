"""The names that `gains` exports: complete, documented, and loaded only when they are used."""

import doctest
import inspect
import re
import subprocess
import sys
from importlib import import_module
from pkgutil import iter_modules

import pytest

import gains
from tests.support.paths import ROOT


def rooms() -> set[str]:
    return {module.name for module in iter_modules(gains.__path__)}


@pytest.mark.parametrize("name", gains.__all__)
def test_an_exported_name_has_an_example_that_imports_it(name: str) -> None:
    value = getattr(gains, name)
    assert value.__name__ == name
    doc = inspect.getdoc(value)
    assert doc
    if inspect.isfunction(value):
        assert any(name in example.source for example in doctest.DocTestParser().get_examples(doc))


def test_the_types_and_the_lazy_imports_name_the_same_things() -> None:
    source = inspect.getsource(gains)
    [typed] = [part for part in source.split("\n\n") if "if TYPE_CHECKING:" in part]
    imported: dict[str, str] = {}
    for line in typed.splitlines():
        if line.startswith("    from "):
            module, names = line.removeprefix("    from ").split(" import ")
            imported |= dict.fromkeys(names.split(", "), module)
    assert sorted(imported) == gains.__all__
    for name, module in imported.items():
        assert getattr(gains, name) is getattr(import_module(module), name)


def test_every_room_is_described() -> None:
    assert gains.__doc__
    described = {line.split("`")[1] for line in gains.__doc__.splitlines() if line.startswith("* `")}
    assert described == rooms()


@pytest.mark.parametrize("package", ["gcs", "docs", "examples"])
def test_internal_modules_are_imported_by_gains_alone(package: str) -> None:
    text = "\n".join(file.read_text() for file in (ROOT / package).rglob("*.py"))
    assert re.findall(r"^ *from gains[\w.]*\._.*", text, re.MULTILINE) == []


def test_the_function_design_is_not_hidden_by_its_room() -> None:
    import_module("gains.design.graph")
    assert inspect.isfunction(gains.design)


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'delay_margins'"):
        getattr(gains, "delay_margins")  # noqa: B009 - a type checker would refuse the attribute too


def test_importing_the_package_loads_no_room_and_no_numpy() -> None:
    code = "import gains, sys; print(*[name for name in sys.modules if name.startswith(('gains.', 'numpy'))])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == ""
