"""The error that a user is shown as one line, and that line for a package that only an extra installs."""

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


def extra_wanted(module: str | None) -> str:
    """The line about a missing module that an extra of this package installs; empty for any other module."""
    package = (module or "").partition(".")[0]
    if package not in _EXTRAS:
        return ""
    return f"the package {package} is not installed; wanted pip install 'formation-gcs[{_EXTRAS[package]}]'"
