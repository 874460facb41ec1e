"""A vehicle's parameters: named numbers that a station lists, reads and sets."""

import math
import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from sim_vehicles.services import messages
from sim_vehicles.services.frames import PARAMETER_VALUE
from sim_vehicles.services.mavlink import Encoder
from sim_vehicles.services.messages import ParameterList, ParameterRead, ParameterSet

LIST_INTERVAL_US = 20_000
"""Time between two parameters of a list. At 37 bytes each, a list takes a third of a 57,600 bit/s radio."""
LONGEST_NAME = 16
TIMEOUT_S = (0.1, 120.0)

_FLOAT, _INT = struct.Struct("<f"), struct.Struct("<i")
_PARAMETER_VALUE = struct.Struct("<4sHH16sB")
"""PARAM_VALUE with the value as four raw bytes: those of an integer may be a NaN's, which may change if handled as a
float."""


@dataclass(frozen=True)
class Parameter:
    """One parameter: its initial value and the values it accepts."""

    name: str
    """At most 16 ASCII characters."""
    value: float
    low: float = -math.inf
    high: float = math.inf
    whole: bool = False
    """True: INT32. False: REAL32."""

    def __post_init__(self) -> None:
        assert self.name.isascii(), self.name
        assert 0 < len(self.name) <= LONGEST_NAME, self.name
        assert self.low <= self.value <= self.high, self.name


class Parameters:
    """The parameters of one vehicle, and its answers about them.

    Values have float32 precision, as on the wire. `bytewise` says how the float field carries an INT32: as its raw
    bytes (PX4), or converted to a float (ArduPilot).
    """

    def __init__(self, known: Iterable[Parameter], *, bytewise: bool = False) -> None:
        self._known = {parameter.name: parameter for parameter in sorted(known, key=lambda parameter: parameter.name)}
        self._names = tuple(self._known)
        self._values: dict[str, float] = {
            name: known.value if known.whole else _FLOAT.unpack(_FLOAT.pack(known.value))[0]
            for name, known in self._known.items()
        }
        self.bytewise = bytewise
        self._listed = len(self._names)
        """Index of the next parameter of a requested list."""

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def answer(
        self, message: ParameterList | ParameterRead | ParameterSet, encoder: Encoder, counters: Counter[str]
    ) -> list[bytes]:
        """The frames to send at once. A list only starts, or restarts, here; `next_of_list` sends it.

        PARAM_SET is answered with the value that then holds: the old one if the new one is not finite, of another type,
        or out of range, which counts as `refused_parameter_value`. An unknown name counts as `refused_parameter_name`.
        """
        if isinstance(message, ParameterList):
            self._listed = 0
            return []
        name = message.param_id
        if isinstance(message, ParameterRead) and message.param_index != -1:  # by index
            name = self._names[message.param_index] if 0 <= message.param_index < len(self._names) else ""
        parameter = self._known.get(name)
        if parameter is None:
            counters["refused_parameter_name"] += 1
            return [encoder.pack(messages.parameter_error(message))]
        if isinstance(message, ParameterSet):
            value = self._read(parameter.whole, message)
            # NaN fails the comparison
            if parameter.low <= value <= parameter.high and value == (round(value) if parameter.whole else value):
                self._values[name] = value
            else:
                counters["refused_parameter_value"] += 1
        return [self._frame(name, encoder)]

    @property
    def listing(self) -> bool:
        """Whether a requested list is not yet complete."""
        return self._listed < len(self._names)

    def next_of_list(self, encoder: Encoder) -> bytes:
        self._listed += 1
        return self._frame(self._names[self._listed - 1], encoder)

    def _frame(self, name: str, encoder: Encoder) -> bytes:
        whole, value = self._known[name].whole, self._values[name]
        data = _INT.pack(int(value)) if self.bytewise and whole else _FLOAT.pack(value)
        place = len(self._names), self._names.index(name)
        payload = _PARAMETER_VALUE.pack(data, *place, name.encode("ascii"), _kind(whole))
        return encoder.frame(PARAMETER_VALUE, payload)

    def _read(self, whole: bool, message: ParameterSet) -> float:
        """The value that a message sets; NaN if it is not valid."""
        if self.bytewise and message.param_type != _kind(whole):
            return math.nan
        data = messages.payload_of(message)[:4].ljust(4, b"\0")
        value = float((_INT if self.bytewise and whole else _FLOAT).unpack(data)[0])
        return value if math.isfinite(value) else math.nan


def _kind(whole: bool) -> int:
    return messages.INT32 if whole else messages.REAL32


def timeout(name: str, value_s: float) -> Parameter:
    """A timeout parameter: how long a stream may be silent, in s."""
    low, high = TIMEOUT_S
    return Parameter(name, value_s, min(low, value_s), max(high, value_s))


def fixed(name: str, value: float) -> Parameter:
    """A parameter that cannot be changed in flight, such as a limit of the vehicle's motion."""
    return Parameter(name, value, value, value, whole=isinstance(value, int))


_ARDUPILOT_VALUES: dict[str, float] = {
    "ARMING_CHECK": 1,
    "FRAME_CLASS": 1,
    "FRAME_TYPE": 1,
    "BATT_MONITOR": 4,
    "BATT_CAPACITY": 3300,
    **{f"COMPASS_DEV_ID{number}": 0 for number in ("", "2", "3")},
    **{f"COMPASS_USE{number}": 0 for number in ("", "2", "3")},
    **{f"COMPASS_OFS{number}_{axis}": 0.0 for number in ("", "2", "3") for axis in "XYZ"},
    **{f"INS_ACCOFFS_{axis}": 0.01 for axis in "XYZ"},
    **{f"RCMAP_{stick}": channel for channel, stick in enumerate(("ROLL", "PITCH", "THROTTLE", "YAW"), 1)},
    **{
        f"RC{channel}_{end}": pulse
        for channel in (1, 2, 3, 4)
        for end, pulse in (("MIN", 1000), ("TRIM", 1500), ("MAX", 2000))
    },
}
_PX4_VALUES: dict[str, float] = {
    "SYS_AUTOSTART": 4001,
    "SYS_HAS_MAG": 1,
    "CAL_ACC0_ID": 1,
    "CAL_GYRO0_ID": 1,
    "CAL_MAG0_ID": 1,
    "BAT1_N_CELLS": 3,
    "BAT1_V_CHARGED": 4.05,
    "BAT1_V_EMPTY": 3.5,
    "COM_RC_IN_MODE": 1,
    **{f"RC_MAP_{stick}": channel for channel, stick in enumerate(("ROLL", "PITCH", "THROTTLE", "YAW"), 1)},
}
ARDUPILOT_SETUP, PX4_SETUP = (
    [Parameter(name, value, whole=isinstance(value, int)) for name, value in values.items()]
    for values in (_ARDUPILOT_VALUES, _PX4_VALUES)
)
"""Parameters without effect. Without them, QGroundControl warns that frame, sensors, radio or battery lack setup."""
