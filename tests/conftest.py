"""Set up before any test module is loaded."""

import pytest
from hypothesis import settings

# no test judges a time: on a busy machine an example may take anything
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A test on the real clock is tried up to three times: neighbours on the machine may hold up any one of them."""
    for item in items:
        if item.get_closest_marker("realtime"):
            item.add_marker(pytest.mark.flaky(reruns=2))
