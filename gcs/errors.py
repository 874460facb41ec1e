"""The error that a user is shown as one line, and that line for a package that only an extra installs."""

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
"""The extra of this package that installs each module."""


class InputError(Exception):
    """The user's input cannot be used: one line with what was read and what was wanted; exit code 2."""


@contextmanager
def usable(what: object, wanted: str) -> Generator[None]:
    """While entered, an OSError is an InputError about what the user named."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{what}: {error.strerror}, wanted {wanted}") from None


def beyond(value: float, limit: float, decimals: int = 0) -> str:
    """A value with as many decimals as show on which side of a limit it is.

    >>> beyond(334.2, 30.0), beyond(10.02, 10.0), beyond(49.96, 50.0, 1)
    ('334', '10.02', '49.96')
    """
    texts = (f"{value:.{count}f}" for count in range(decimals, 18))
    return next(
        (text for text in texts if float(text) != limit and (float(text) > limit) == (value > limit)), f"{value}"
    )


def extra_wanted(module: str | None) -> str:
    """The line about a missing module that an extra of this package installs; empty for any other module."""
    package = (module or "").partition(".")[0]
    if package not in _EXTRAS:
        return ""
    return f"the package {package} is not installed; wanted pip install 'formation-gcs[{_EXTRAS[package]}]'"
