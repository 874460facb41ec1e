"""The `gains` API: what `gains` exports, every function and class whose docstring has an example, and their types.

An example in a docstring finds the names of its module; on the page it begins with the imports that it needs.
"""

import ast
import doctest
import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterable, Iterator
from functools import cache
from types import ModuleType

import gains


def api_page() -> str:
    """A section for each module, with the signatures and the docstrings of what it offers."""
    return "\n\n".join(text for module in _modules() if (text := _module(module)))


def _modules() -> Iterator[ModuleType]:
    for module in pkgutil.walk_packages(gains.__path__, "gains."):
        if "._" not in module.name:
            yield importlib.import_module(module.name)


def documented(module: ModuleType) -> dict[str, str]:
    """The docstrings of what a module offers, by name, with examples that run in an empty session."""
    return {node.name: _with_imports(module, ast.get_docstring(node) or "") for node in _offered(module)}


def _module(module: ModuleType) -> str:
    texts = documented(module)
    entries = [_entry(node, texts[node.name]) for node in _offered(module)]
    if not entries:
        return ""
    return "\n\n".join([f"## `{module.__name__}`", _markdown(inspect.getdoc(module) or ""), *entries])


def _offered(module: ModuleType) -> list[ast.FunctionDef | ast.ClassDef]:
    return [
        node
        for node in _implemented(module)
        if _explained(node) or (isinstance(node, ast.ClassDef) and node.name in _types())
    ]


def _implemented(module: ModuleType) -> Iterable[ast.FunctionDef | ast.ClassDef]:
    """The public functions and classes; of an overloaded function the last, which has the docstring."""
    return {
        node.name: node
        for node in ast.parse(inspect.getsource(module)).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
    }.values()


def _explained(node: ast.FunctionDef | ast.ClassDef) -> bool:
    return node.name in gains.__all__ or ">>> " in (ast.get_docstring(node) or "")


@cache
def _types() -> set[str]:
    """The names in the signatures of the functions that are explained."""
    nodes = [node for module in _modules() for node in _implemented(module) if _explained(node)]
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    return set(re.findall(r"\w+", " ".join(f"{ast.unparse(each.args)} {_result(each)}" for each in functions)))


def _result(node: ast.FunctionDef) -> str:
    return f" -> {ast.unparse(node.returns)}" if node.returns else ""


def _with_imports(module: ModuleType, docstring: str) -> str:
    """A docstring whose example begins with the imports of what it takes from its module."""
    source = "".join(example.source for example in doctest.DocTestParser().get_examples(docstring))
    used: dict[str, list[str]] = {}
    nodes = list(ast.walk(ast.parse(source)))
    known = {alias.name for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names}
    for name in sorted({node.id for node in nodes if isinstance(node, ast.Name)} - known):
        value = vars(module).get(name)
        if isinstance(value, ModuleType):
            used[f"import {value.__name__} as {name}"] = []
        elif value is not None:
            home = "gains" if name in gains.__all__ else getattr(value, "__module__", "math")
            used.setdefault(f"from {home} import ", []).append(name)
    lines = "".join(f">>> {start}{', '.join(names)}\n" for start, names in used.items())
    return docstring.replace(">>> ", lines + ">>> ", 1)


def _entry(node: ast.FunctionDef | ast.ClassDef, docstring: str) -> str:
    if isinstance(node, ast.ClassDef):
        fields = [each for each in node.body if isinstance(each, ast.AnnAssign)]
        signature = "\n    ".join([f"class {node.name}:", *(ast.unparse(each) for each in fields)])
        described = [f"* `{name}`: {' '.join(about.split())}" for name, about in _described_fields(node)]
    else:
        signature, described = f"{node.name}({_arguments(node.args)}){_result(node)}", []
    signature = signature.replace("'", '"')  # as ruff formats it, in Markdown too
    text = "\n\n".join([_markdown(docstring), *(["\n".join(described)] if described else [])])
    return f"### `{node.name}`\n\n```python\n{signature}\n```\n\n{text}"


def _described_fields(node: ast.ClassDef) -> Iterator[tuple[str, str]]:
    """The fields with a docstring below them; fields of one type in a row may share it."""
    names: list[str] = []
    annotation = ""
    for each in node.body:
        if isinstance(each, ast.AnnAssign):
            names = [*names, ast.unparse(each.target)] if ast.unparse(each.annotation) == annotation else []
            names, annotation = names or [ast.unparse(each.target)], ast.unparse(each.annotation)
        elif isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant) and names:
            yield "`, `".join(names), str(each.value.value)
            names, annotation = [], ""


def _arguments(arguments: ast.arguments) -> str:
    """The arguments, one a line if they are many."""
    text = ast.unparse(arguments)
    return text if len(text) < 80 else "\n    " + re.sub(r", (?=\*|\w+:)", ",\n    ", text) + ",\n"


def _markdown(docstring: str) -> str:
    """A docstring as Markdown: examples and displayed equations as code."""
    return "\n\n".join(_paragraph(each) for each in re.split(r"\n{2,}", docstring))


def _paragraph(text: str) -> str:
    lines = text.split("\n")
    if lines[0].startswith(">>>"):
        return "```python\n" + text + "\n```"
    if all(line.startswith("    ") for line in lines):
        return "```text\n" + inspect.cleandoc(text) + "\n```"
    return text
