"""Figures that a test needs to be known."""


def known(value: float | None) -> float:
    """The figure; an error if it is unknown."""
    assert value is not None
    return value
