"""The `gains` API: every function and class whose docstring has an example, which are those that a user calls."""

import ast
import importlib
import inspect
import pkgutil
import re
from types import ModuleType
from typing import Any

import gains


def api_page() -> str:
    """A section for each module, with the signatures and the docstrings of what it offers."""
    found = pkgutil.walk_packages(gains.__path__, "gains.")
    modules = [importlib.import_module(module.name) for module in found if "._" not in module.name]
    return "\n\n".join(text for module in modules if (text := _module(module)))


def _module(module: ModuleType) -> str:
    source = ast.parse(inspect.getsource(module))
    entries = [
        _entry(node)
        for node in source.body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        and not node.name.startswith("_")
        and "Examples\n--------" in (ast.get_docstring(node) or "")
    ]
    if not entries:
        return ""
    return "\n\n".join([f"## `{module.__name__}`", _markdown(inspect.getdoc(module) or ""), *entries])


def _entry(node: Any) -> str:
    text = _markdown(ast.get_docstring(node) or "")
    if isinstance(node, ast.ClassDef):
        fields = [each for each in node.body if isinstance(each, ast.AnnAssign)]
        signature = "\n    ".join([f"class {node.name}:", *(ast.unparse(each) for each in fields)])
    else:
        overloaded = any("overload" in ast.unparse(decorator) for decorator in node.decorator_list)
        assert not overloaded, node.name  # its implementation has the docstring
        result = f" -> {ast.unparse(node.returns)}" if node.returns else ""
        signature = f"{node.name}({_arguments(node.args)}){result}"
    signature = signature.replace("'", '"')  # as ruff formats it, in Markdown too
    return f"### `{node.name}`\n\n```python\n{signature}\n```\n\n{text}"


def _arguments(arguments: ast.arguments) -> str:
    """The arguments, one a line if they are many."""
    text = ast.unparse(arguments)
    return text if len(text) < 80 else "\n    " + re.sub(r", (?=\*|\w+:)", ",\n    ", text) + ",\n"


def _markdown(docstring: str) -> str:
    """A numpydoc docstring as Markdown: sections in bold, examples and displayed equations as code."""
    text = re.sub(r"^(\w[\w ]*)\n-{3,}$", r"**\1**\n", docstring, flags=re.MULTILINE)
    return "\n\n".join(_paragraph(each) for each in re.split(r"\n{2,}", text))


def _paragraph(text: str) -> str:
    lines = text.split("\n")
    if lines[0].startswith(">>>"):
        return "```python\n" + text + "\n```"
    if all(line.startswith("    ") for line in lines):
        return "```text\n" + inspect.cleandoc(text) + "\n```"
    if len(lines) > 1 and all(line.startswith("    ") for line in lines[1:]):  # a name, and what it is
        return f"`{lines[0]}`: " + " ".join(line.strip() for line in lines[1:])
    if any(line.startswith("    ") for line in lines) and not lines[0].startswith(" "):
        return _definitions(lines)
    return text


def _definitions(lines: list[str]) -> str:
    """Names, each with its indented description, as a list."""
    items: list[str] = []
    for line in lines:
        if line.startswith(" ") and items:
            items[-1] += (" " if ": " in items[-1] else ": ") + line.strip()
        else:
            items.append(f"* `{line}`")
    return "\n".join(items)
