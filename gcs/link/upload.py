"""Parameter upload to one vehicle: parameters are set, read back and compared before the vehicle may be armed.

A vehicle answers PARAM_SET with PARAM_VALUE, the value now in effect. Once all are set, each is read back with
PARAM_REQUEST_READ. Unanswered messages are resent. Links may be slow, so many parameters may be in flight at once.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from gcs.link import mavlink

PATIENCE_NS = 1_000_000_000
"""Timeout of an answer, or three round trips if that is longer."""
ATTEMPTS = 3
"""A parameter's third wrong value refuses the vehicle: the first may have been sent before the value was set."""
_LONG_AGO_NS = -(1 << 62)
_FLOAT = struct.Struct("<f")


class _Stage(IntEnum):
    TO_SET = 0
    TO_READ = 1
    COMPARED = 2


@dataclass
class _Item:
    value: float
    """Rounded to float32, as it is transmitted."""
    stage: _Stage = _Stage.TO_SET
    sent_ns: int = _LONG_AGO_NS
    wrong: int = 0


class Upload:
    """The upload of one vehicle's parameters: `next` gives the frame to send, `take` processes an answer."""

    def __init__(self, wanted: dict[str, float]) -> None:
        self._items = {name: _Item(float32(value)) for name, value in wanted.items()}
        self.done = not wanted
        """Whether every parameter has been read back and is correct."""
        self.refusal = ""
        """Why the vehicle must not be armed; empty if it may."""

    @property
    def missing(self) -> str:
        """Why the upload is not complete, in words; empty if it is."""
        for name, item in self._items.items():
            if item.stage is not _Stage.COMPARED:
                return self.refusal or f"does not answer to parameter {name}"
        return ""

    def begin_anew(self) -> None:
        """Upload everything again: the vehicle seems to have restarted."""
        self.done = not self._items
        for item in self._items.values():
            item.stage, item.sent_ns = _Stage.TO_SET, _LONG_AGO_NS

    def next(self, now_ns: int, *, target_system: int, rtt_ns: int) -> tuple[int, tuple[Any, ...]] | None:
        """Message id and fields of the message that is due, if any. All parameters are set before any is read back."""
        if self.done or self.refusal:
            return None
        stage = min(item.stage for item in self._items.values())
        patience_ns = max(PATIENCE_NS, 3 * rtt_ns)
        for name, item in self._items.items():
            if item.stage is stage is not _Stage.COMPARED and now_ns - item.sent_ns >= patience_ns:
                item.sent_ns = now_ns
                if stage is _Stage.TO_SET:
                    return mavlink.PARAM_SET, mavlink.param_set(name, item.value, target_system=target_system)
                return mavlink.PARAM_REQUEST_READ, mavlink.param_request_read(name, target_system=target_system)
        return None

    def take(self, fields: tuple[Any, ...]) -> None:
        value, _, _, field, _ = fields
        name = field.partition(b"\0")[0].decode("ascii", "replace")
        item = self._items.get(name)
        if item is None or item.sent_ns == _LONG_AGO_NS or item.stage is _Stage.COMPARED:
            return
        item.sent_ns = _LONG_AGO_NS  # makes its next message due at once
        if value == item.value:
            item.stage = _Stage(item.stage + 1)
            self.done = all(other.stage is _Stage.COMPARED for other in self._items.values())
            return
        item.wrong += 1
        item.stage = _Stage.TO_SET
        if item.wrong >= ATTEMPTS:
            self.refusal = f"holds {value:.9g} in parameter {name} after {item.value:.9g} was set: it is not armed"


def float32(value: float) -> float:
    """The number rounded to a MAVLink float."""
    rounded: float = _FLOAT.unpack(_FLOAT.pack(value))[0]
    return rounded
