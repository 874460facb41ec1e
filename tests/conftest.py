"""Settings that apply before any test module is loaded."""

import os
from collections import Counter

import pytest
from hypothesis import settings

SLOW = os.environ.get("SLOW_TESTS") == "1"
# no test judges run time: on a busy machine an example may take any time
settings.register_profile("untimed", deadline=None, max_examples=100 if SLOW else 50)
settings.load_profile("untimed")


CASES = Counter[str]()
"""How many cases of each slow test have been collected so far."""


def pytest_itemcollected(item: pytest.Item) -> None:
    """Skip all but the first cases of slow tests, and run `realtime` tests up to three times until they pass.

    Other processes on the machine may delay any single run.
    """
    if item.get_closest_marker("realtime"):
        item.add_marker(pytest.mark.flaky(reruns=2))
    if (slow := item.get_closest_marker("slow")) is not None:
        test = item.nodeid.split("[")[0]
        CASES[test] += 1
        if CASES[test] > slow.kwargs["first"] and not SLOW:
            item.add_marker(pytest.mark.skip(reason="slow: runs with SLOW_TESTS=1"))
