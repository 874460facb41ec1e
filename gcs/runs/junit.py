"""Writes the checks of a command as JUnit XML for CI."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree


@dataclass(frozen=True)
class Check:
    """One test case. It has passed if all three texts are empty."""

    name: str
    failure: str = ""
    skipped: str = ""
    error: str = ""
    """The traceback, if the check itself failed to run."""


def write_junit(file: Path, suite_name: str, checks: Sequence[Check], *, time_s: float) -> None:
    """Write a test suite that took `time_s` seconds."""
    counts = {kind: sum(bool(getattr(check, kind)) for check in checks) for kind in ("failure", "error", "skipped")}
    suite = ElementTree.Element(
        "testsuite",
        name=suite_name,
        tests=str(len(checks)),
        failures=str(counts["failure"]),
        errors=str(counts["error"]),
        skipped=str(counts["skipped"]),
        time=str(time_s),
    )
    for check in checks:
        case = ElementTree.SubElement(suite, "testcase", classname=suite_name, name=check.name)
        if check.failure:
            ElementTree.SubElement(case, "failure", message=check.failure)
        if check.skipped:
            ElementTree.SubElement(case, "skipped", message=check.skipped)
        if check.error:
            last = check.error.strip().splitlines()[-1]
            ElementTree.SubElement(case, "error", message=last).text = check.error
    ElementTree.ElementTree(suite).write(file, encoding="utf-8", xml_declaration=True)
