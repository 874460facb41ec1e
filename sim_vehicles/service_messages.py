"""Messages by which a station asks a vehicle for more than it reports: to typed requests, and answers to frames."""

import struct
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

PARAMETER_READ = dialect.MAVLINK_MSG_ID_PARAM_REQUEST_READ
PARAMETER_LIST = dialect.MAVLINK_MSG_ID_PARAM_REQUEST_LIST
PARAMETER_VALUE = dialect.MAVLINK_MSG_ID_PARAM_VALUE
PARAMETER_SET = dialect.MAVLINK_MSG_ID_PARAM_SET
REAL32, INT32 = dialect.MAV_PARAM_TYPE_REAL32, dialect.MAV_PARAM_TYPE_INT32
DOES_NOT_EXIST = dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
BY_NAME = -1
"""PARAM_REQUEST_READ.param_index of a request by name."""

# The value as its four bytes: an integer sent bytewise may look like a NaN, which a float need not carry exactly.
_PARAMETER_VALUE = struct.Struct("<4sHH16sB")
_LAYOUTS = {
    PARAMETER_LIST: dialect.MAVLink_param_request_list_message.unpacker,
    PARAMETER_READ: dialect.MAVLink_param_request_read_message.unpacker,
    PARAMETER_SET: struct.Struct("<4sBB16sB"),
}
REQUESTS = frozenset(_LAYOUTS)
"""Ids of the messages that are requests."""


class ParameterList(NamedTuple):
    """PARAM_REQUEST_LIST."""

    target_system: int
    target_component: int


class ParameterRead(NamedTuple):
    """PARAM_REQUEST_READ; `number` is the index, BY_NAME if the name counts."""

    target_system: int
    target_component: int
    number: int
    name: str


class ParameterSet(NamedTuple):
    """PARAM_SET; `value` is its four bytes."""

    target_system: int
    target_component: int
    name: str
    value: bytes
    kind: int
    """MAV_PARAM_TYPE"""


Request = ParameterList | ParameterRead | ParameterSet


def request(number: int, payload: bytes) -> Request:
    """The typed request of one of REQUESTS; trailing zeros of its payload need not be there."""
    layout = _LAYOUTS[number]
    values = layout.unpack(payload[: layout.size].ljust(layout.size, b"\0"))
    if number == PARAMETER_LIST:
        return ParameterList(*values)
    if number == PARAMETER_READ:
        index, system, component, name = values
        return ParameterRead(system, component, index, _name(name))
    value, system, component, name, kind = values
    return ParameterSet(system, component, _name(name), value, kind)


def parameter_value(name: str, value: bytes, kind: int, index: int, count: int) -> bytes:
    """The payload of PARAM_VALUE, with the value as its four bytes."""
    return _PARAMETER_VALUE.pack(value, count, index, name.encode("ascii"), kind)


def parameter_error(message: ParameterRead | ParameterSet, error: int) -> dialect.MAVLink_message:
    """PARAM_ERROR to whoever asked; the frame bears no addressee but all."""
    index = message.number if isinstance(message, ParameterRead) else BY_NAME
    return dialect.MAVLink_param_error_message(0, 0, message.name.encode("ascii", "replace")[:16], index, error)


def _name(field: bytes) -> str:
    """A parameter's name; 16 characters have no zero at their end."""
    return field.partition(b"\0")[0].decode("ascii", "replace")
