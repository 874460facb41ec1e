"""What the terminal says about code of the user's own: which files run, and margins that nobody could compute."""

from rich.console import Console

from gcs.plan.design import CodeRecord
from gcs.runs.summary_record import LawRecord

_HASH = 12
"""Digits of a hash that are shown."""


def code_text(code: tuple[CodeRecord, ...]) -> str:
    """The files of code with their hashes."""
    return ", ".join(f"{each.file}, sha256 {each.sha256[:_HASH]}" for each in code)


def print_code(code: tuple[CodeRecord, ...], console: Console) -> None:
    if code:
        console.print(f"code     {code_text(code)}", markup=False)


def law_text(law: LawRecord) -> str:
    """How often a law was called, and how often in vain or too long."""
    slow = "" if law.over_budget is None else f", {law.over_budget} over {1e3 * law.budget_s:g} ms"
    return f"{law.calls} calls, {law.unusable} without a usable command{slow}"
