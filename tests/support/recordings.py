"""What a Rerun recording says, for the tests of what is recorded."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader


def read_back(recording: Path, entity: str, component: str) -> tuple[Any, Any]:
    """Times in s and values, shape (times, vehicles, ...), of one entity in the order of time."""
    times: list[float] = []
    values: list[Any] = []
    for chunk in RrdReader(recording).stream().filter(content=entity, is_static=False, components=component):
        batch = chunk.to_record_batch()
        times += [time / 1e9 for time in batch.column("sim_time").cast(pa.int64()).to_pylist()]
        values += batch.column(component).to_pylist()
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], np.array(values, dtype=float)[order]
