"""A map on Dask: the workers fly it, and its costs are measured."""

import contextlib
import socket

from gcs.studies.cluster import map_on_cluster
from scenarios.files import load
from tests.support.paths import SCENARIOS


def test_one_worker_or_all_fly_a_map_beside_another_cluster() -> None:
    with socket.socket() as taken:
        with contextlib.suppress(OSError):  # another cluster already has it
            taken.bind(("127.0.0.1", 8787))  # Dask's default port; Dask warns if it is taken
        found = map_on_cluster(load(SCENARIOS / "chain3.toml"), trials=4, workers=2, seconds=0.5)
    assert (found.trials, found.workers) == (4, 2)
    assert min(found.to_dict().values()) > 0.0
    assert found.trial_bytes < 10_000.0  # a trial carries a scenario and gains, no plan
