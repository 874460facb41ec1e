"""Reads and writes the scenario, design, ticks, events and summary in the folder of a run.

A damaged file, or one of another kind, raises gcs.errors.InputError with a one-line message.
"""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from gcs.control.tick import TICK, Event, Mode, TickArray, chosen
from gcs.errors import InputError, usable
from gcs.plan.design import Design
from gcs.published import Published
from gcs.runs.record import DESIGN_FILE, EVENTS_FILE, PARQUET_FILE, SCENARIO_FILE, TICKS_FILE, write_whole
from gcs.runs.summary_record import Summary
from scenarios import files as scenario_files
from scenarios.own_code import write_code
from scenarios.schema import Scenario

_Record = TypeVar("_Record", bound=Published)
_EVENT = TypeAdapter(Event)


Rows = NDArray[np.void]


def read_scenario(folder: Path) -> Scenario:
    """The scenario of a run as flown. Raises InputError if it is missing, ScenarioError if the file is damaged."""
    if not (folder / SCENARIO_FILE).exists():
        raise InputError(f"{folder}: read no {SCENARIO_FILE}, wanted the folder of a run")
    return scenario_files.load(folder / SCENARIO_FILE)


def read_design(file: Path) -> Design:
    """The design in a design.json; only its delay margin is required."""
    return _checked(file, Design, f"the {DESIGN_FILE} of a run")


def write_design(folder: Path, design: Design) -> None:
    """Write a run's design.json atomically."""
    write_whole(folder / DESIGN_FILE, design.to_json().encode())


def write_scenario(folder: Path, scenario: Scenario) -> None:
    """Write a scenario, and the code that it names."""
    write_whole(folder / SCENARIO_FILE, scenario_files.dump(scenario).encode())
    write_code(scenario, folder)


def write_experiment(folder: Path, scenario: Scenario, design: Design) -> None:
    write_scenario(folder, scenario)
    write_design(folder, design)


def read_summary(file: Path) -> Summary:
    return _checked(file, Summary, "the summary of a run")


def read_ticks(folder: Path) -> TickArray:
    """All tick rows of a run, finished or not."""
    file = next((file for name in (TICKS_FILE, PARQUET_FILE) if (file := folder / name).exists()), None)
    if file is None:
        raise InputError(f"{folder}: read neither {TICKS_FILE} nor {PARQUET_FILE}, wanted the folder of a run")
    ticks = RunTail(folder).ticks() if file.name == TICKS_FILE else _from_parquet(file)
    if not (np.isfinite(ticks["time_s"]).all() and (ticks["mode"] <= max(Mode)).all()):
        raise InputError(f"{file}: read rows that are damaged, wanted the ticks of a run")
    return ticks


_ADDED = {"delay_margin_s": np.nan, "loop_delay_bound_s": np.nan, "repeated_s": 0.0, "assumed_delay_s": 0.0}
"""Columns that older runs lack, and the value that stands in for each."""


def _from_parquet(file: Path) -> TickArray:
    import pyarrow as pa
    import pyarrow.parquet as pq

    def values(column: Any) -> Any:
        # column.to_numpy() and pq.read_table would import pandas if that is installed, which takes a fifth of a second
        column = column.cast(pa.uint8()) if column.type == pa.bool_() else column
        return np.from_dlpack(column.combine_chunks())

    try:
        table = pq.ParquetFile(file).read()
        ticks = np.empty(table.num_rows, TICK)
        for name in TICK.names or ():
            added = name in _ADDED and name not in table.column_names
            ticks[name] = _ADDED[name] if added else values(table[name])
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise InputError(f"{file}: {str(error).strip()}, wanted the ticks of a run") from None
    return ticks


def _checked(file: Path, kind: type[_Record], wanted: str) -> _Record:
    with usable(file, wanted):
        text = file.read_bytes()
    try:
        return kind.model_validate_json(text, strict=True)
    except ValidationError as errors:
        raise InputError(f"{file}: {_first(errors)}; wanted {wanted}") from None


def _first(errors: ValidationError) -> str:
    """The first of pydantic's errors as text: the key, what was read, what should be there."""
    first = errors.errors()[0]
    key = ".".join(map(str, first["loc"]))
    if first["type"] in ("json_invalid", "missing"):
        return f"{key}: missing" if key else first["msg"]
    read = " ".join(repr(first["input"]).split())
    message = first["msg"].replace("Input should be", "should be")
    return f"{key + ': ' if key else ''}read {read if len(read) <= 60 else read[:57] + '...'}, {message}"


def by_tick(rows: TickArray, system_ids: Sequence[int]) -> TickArray:
    """Rows of a run as whole ticks: shape (ticks, vehicles), the vehicles in the order of `system_ids`.

    An incomplete last tick, as a killed station may leave it, is dropped.
    """
    count = len(system_ids)
    ticks = rows[: rows.size // count * count].reshape(-1, count)
    written = ticks["system_id"][:1].ravel().tolist()
    return ticks[:, [written.index(system_id) for system_id in system_ids]] if written else ticks


def by_vehicle(rows: Rows) -> defaultdict[int, Rows]:
    """Rows grouped by system id, in their original order; any other id gives an empty array."""
    order = rows["system_id"].argsort(kind="stable")
    system_ids, first = np.unique(rows["system_id"][order], return_index=True)
    found = zip(system_ids.tolist(), np.split(order, first[1:]), strict=False)
    return defaultdict(lambda: rows[:0], {system_id: chosen(rows, own) for system_id, own in found})


class RunTail:
    """Reads the ticks and events added to a run since the last call; the run may still be growing.

    `vehicles` is the number of rows of a tick. With 1, single rows of an incomplete tick are returned, too.
    """

    def __init__(self, folder: Path, vehicles: int = 1) -> None:
        self._folder = folder
        self._tick_bytes = vehicles * TICK.itemsize
        self._ticks_read = 0
        self._events_read = 0

    def ticks(self) -> TickArray:
        """New rows, in the order in which they were written; an incomplete tick is left for the next call."""
        data, count = self._new(TICKS_FILE, self._ticks_read, self._tick_bytes)
        self._ticks_read += count
        return np.frombuffer(data[:count], dtype=TICK)

    def events(self) -> list[Event]:
        """New events, in the order in which they were written."""
        data, _ = self._new(EVENTS_FILE, self._events_read, 1)
        whole = data[: data.rfind(b"\n") + 1]
        self._events_read += len(whole)
        try:
            return [_EVENT.validate_json(line, strict=True) for line in whole.splitlines()]
        except ValidationError as errors:
            raise InputError(f"{self._folder / EVENTS_FILE}: {_first(errors)}; wanted the events of a run") from None

    def _new(self, name: str, start: int, unit: int) -> tuple[bytes, int]:
        with usable(self._folder / name, "a file of a run"):
            if not (self._folder / name).exists():
                return b"", 0
            with (self._folder / name).open("rb") as file:
                file.seek(start)
                data = file.read()
        return data, len(data) - len(data) % unit
