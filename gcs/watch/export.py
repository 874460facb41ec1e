"""Exports a run or a telemetry log for other tools: as MCAP (Foxglove, PlotJuggler) or CSV.

A run gives the topics `/vehicle/ID/tick`, with the columns of ticks.parquet, and `/events`. A telemetry log gives one
topic for each sender and message type, for example `/mavlink/ID/LOCAL_POSITION_NED`. Times of a run count from its
first tick on the station's clock, those of a log from 1970.
"""

import csv
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gains.core.requirement import plain
from gcs.control.tick import TickArray
from gcs.link import mavlink
from gcs.runs.files import RunTail, read_ticks
from gcs.watch.tlog import read_tlog
from scenarios.schema import NS_PER_S

_TYPES = {bool: "boolean", int: "integer", float: "number", str: "string", dict: "object", list: "array"}


class Message(NamedTuple):
    """One message of a topic."""

    topic: str
    table: str
    """Name of its CSV file, without the extension."""
    time_ns: int
    fields: dict[str, Any]
    """The known values by name; unknown ones are left out."""


def messages_of(source: Path) -> list[Message]:
    """The messages of a run's folder, in order of time, or of a telemetry log, in the order of the log.

    Raises InputError if `source` is neither.
    """
    if source.is_dir():
        return sorted(_of_run(source), key=lambda message: message.time_ns)
    return list(_of_log(source))


def _of_run(folder: Path) -> Iterator[Message]:
    ticks = read_ticks(folder)
    names = ticks.dtype.names or ()
    began_ns = int(ticks["due_ns"][0]) if ticks.size else 0
    for row in ticks.tolist():
        fields = _known(dict(zip(names, row, strict=True)))
        yield Message(f"/vehicle/{fields['system_id']}/tick", "ticks", fields["due_ns"] - began_ns, fields)
    for event in RunTail(folder).events():
        yield Message("/events", "events", _since_ns(ticks, event.time_s), _known(asdict(event)))


def _since_ns(ticks: TickArray, time_s: float) -> int:
    """Convert the scenario time of an event to ns since the first tick.

    Scenario time jumps to 0 when the formation is complete, but the station's clock does not. The event is therefore
    placed relative to the last tick before it.
    """
    if not ticks.size:
        return 0
    before = ticks[max(0, int(np.searchsorted(ticks["time_s"], time_s, side="right")) - 1)]
    later_ns = max(0, round((time_s - float(before["time_s"])) * NS_PER_S))
    return int(before["due_ns"]) - int(ticks["due_ns"][0]) + later_ns


def _of_log(file: Path) -> Iterator[Message]:
    for time_ns, frame in read_tlog(file).frames:
        name = mavlink.message_name(frame.msg_id)
        sender = {"system_id": frame.system_id, "component_id": frame.component_id}
        yield Message(f"/mavlink/{frame.system_id}/{name}", name, time_ns, sender | _known(mavlink.named_fields(frame)))


def _known(fields: dict[str, Any]) -> dict[str, Any]:
    """The fields except those that are None, NaN or infinite: JSON cannot represent the last two."""
    return {name: value for name, value in fields.items() if plain(value) is not None}


def write_mcap(file: Path, messages: Sequence[Message]) -> None:
    """Write messages as JSON with a schema for each topic; needs the package mcap."""
    from mcap.writer import Writer

    properties: dict[str, dict[str, dict[str, str]]] = defaultdict(dict)
    for message in messages:
        own = properties[message.table]
        own.update({name: {"type": _TYPES[type(value)]} for name, value in message.fields.items() if name not in own})
    with file.open("wb") as out:
        writer = Writer(out)
        writer.start(library="formation-gcs")
        schemas = {
            table: writer.register_schema(
                table, "jsonschema", json.dumps({"title": table, "type": "object", "properties": own}).encode()
            )
            for table, own in properties.items()
        }
        channels = {
            topic: writer.register_channel(topic, "json", schemas[table])
            for topic, table in dict.fromkeys((message.topic, message.table) for message in messages)
        }
        for message in messages:
            data = json.dumps(message.fields).encode()
            writer.add_message(channels[message.topic], message.time_ns, data, message.time_ns)
        writer.finish()


def write_csv(folder: Path, messages: Iterable[Message]) -> list[Path]:
    """Write one file for each table, with the columns of all its messages; returns the files."""
    tables: dict[str, list[dict[str, Any]]] = {}
    for message in messages:
        row = {"time_ns": message.time_ns} | message.fields
        tables.setdefault(message.table, []).append(row)
    files = [folder / f"{name}.csv" for name in tables]
    for file, rows in zip(files, tables.values(), strict=True):
        columns = dict.fromkeys(name for row in rows for name in row)
        with file.open("w", newline="", encoding="utf-8") as out:
            writer = csv.DictWriter(out, list(columns))
            writer.writeheader()
            writer.writerows(rows)
    return files
