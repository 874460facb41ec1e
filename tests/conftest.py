"""Set up before any test module is loaded."""

import os
from collections import Counter

import pytest
from hypothesis import settings

SLOW = os.environ.get("SLOW_TESTS") == "1"
# no test judges a time: on a busy machine an example may take anything
settings.register_profile("untimed", deadline=None, max_examples=100 if SLOW else 50)
settings.load_profile("untimed")


CASES = Counter[str]()
"""How many cases of each slow test there are so far, in the order of its parameters."""


def pytest_itemcollected(item: pytest.Item) -> None:
    """Skip the further cases of slow tests, and let tests on the real clock try up to three times.

    Neighbours on the machine may hold up any one of the latter.
    """
    if item.get_closest_marker("realtime"):
        item.add_marker(pytest.mark.flaky(reruns=2))
    if (slow := item.get_closest_marker("slow")) is not None:
        test = item.nodeid.split("[")[0]
        CASES[test] += 1
        if CASES[test] > slow.kwargs["first"] and not SLOW:
            item.add_marker(pytest.mark.skip(reason="slow: runs with SLOW_TESTS=1"))
