"""The error that scenario files raise, apart from what reads them: whoever only names it need not wait for that."""

from pathlib import Path


class ScenarioError(Exception):
    """A scenario that cannot be flown."""

    def __init__(self, file: Path, key: str, read: object, wanted: str) -> None:
        shown = " ".join(repr(read).split())
        shown = shown if len(shown) <= 80 else shown[:77] + "..."
        super().__init__(f"{file}: {key}: read {shown}, wanted {wanted}")
