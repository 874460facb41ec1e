"""Finds the generated blocks in Markdown pages, reads them and fills them in."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The repository."""

_BLOCK = re.compile(r"(?P<begin><!-- generated: (?P<name>[\w-]+) -->\n)(?P<body>.*?)(?P<end><!-- end -->)", re.DOTALL)
MEASURED_ON = "Measured on "
"""Begins the line with machine and date, the only one that may differ between measurements of an exact figure."""


def pages() -> list[Path]:
    """Every Markdown page of the documentation."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks_of(page: Path) -> dict[str, str]:
    """The generated blocks of a page, by name."""
    return {found["name"]: found["body"] for found in _BLOCK.finditer(page.read_text(encoding="utf-8"))}


def pages_with(name: str) -> list[Path]:
    """The pages that hold a block of this name."""
    return [page for page in pages() if name in blocks_of(page)]


def fill(contents: Mapping[str, str]) -> list[Path]:
    """Write the blocks of these names into every page that has them; return the pages that changed."""
    changed: list[Path] = []

    def filled(found: re.Match[str]) -> str:
        text = contents.get(found["name"])
        return found[0] if text is None else f"{found['begin']}\n{text.strip()}\n\n{found['end']}"

    for page in pages():
        before = page.read_text(encoding="utf-8")
        after = _BLOCK.sub(filled, before)
        if after != before:
            page.write_text(after, encoding="utf-8")
            changed.append(page)
    return changed


def differing(name: str, text: str) -> list[Path]:
    """The pages whose block of this name differs from `text`, apart from machine and date."""
    return [page for page in pages_with(name) if _compared(blocks_of(page)[name]) != _compared(text)]


def _compared(text: str) -> list[str]:
    return [line for line in text.strip().splitlines() if not line.startswith(MEASURED_ON)]


def once_each(makers: Mapping[str, Callable[[], str]]) -> dict[str, str]:
    """The text of every block that a page asks for."""
    wanted = {name for page in pages() for name in blocks_of(page)}
    return {name: make() for name, make in makers.items() if name in wanted}


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """A Markdown table."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
