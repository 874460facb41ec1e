"""The error that is shown to users as one line, and the text of that line where an optional package is missing."""

from collections.abc import Generator
from contextlib import contextmanager

_EXTRAS = {
    "cvxpy": "solver",
    "clarabel": "solver",
    "rerun": "viewer",
    "rerun_cli": "viewer",
    "matplotlib": "plots",
    "mcap": "mcap",
    "distributed": "cluster",
}
"""For each optional module, the extra of this package that installs it."""


class InputError(Exception):
    """Unusable user input. Its message is one line that says what was read and what was wanted; the exit code is 2."""


@contextmanager
def usable(what: object, wanted: str) -> Generator[None]:
    """Context manager that turns an OSError into an InputError about `what`, which the user named."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{what}: {error.strerror}, wanted {wanted}") from None


def beyond(value: float, limit: float, decimals: int = 0) -> str:
    """A value as text, with enough decimals (at least `decimals`) to show on which side of a limit it lies.

    >>> beyond(334.2, 30.0), beyond(10.02, 10.0), beyond(49.96, 50.0, 1)
    ('334', '10.02', '49.96')
    """
    texts = (f"{value:.{count}f}" for count in range(decimals, 18))
    return next(
        (text for text in texts if float(text) != limit and (float(text) > limit) == (value > limit)), f"{value}"
    )


def extra_wanted(module: str | None) -> str:
    """The message for a missing module that an extra of this package installs; empty for any other module."""
    package = (module or "").partition(".")[0]
    if package not in _EXTRAS:
        return ""
    return f"the package {package} is not installed; wanted pip install 'formation-gcs[{_EXTRAS[package]}]'"
