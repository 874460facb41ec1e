"""What a user gives to a command, and the one line that says what is wrong with it."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gcs.udp import StationSocket


class InputError(Exception):
    """The user's input cannot be used: one line with what was read and what was wanted; exit code 2."""


def address(option: str, text: str) -> tuple[str, int]:
    """HOST:PORT as given to an option."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 <= int(port) < 65536:
        raise InputError(f"{option}: read {text!r}, wanted HOST:PORT, as 127.0.0.1:14550")
    return host, int(port)


def listening(option: str, text: str) -> "StationSocket":
    """A socket that listens at the HOST:PORT given to an option."""
    from gcs.udp import StationSocket

    host, port = address(option, text)
    try:
        return StationSocket(host, port)
    except OSError as error:
        raise InputError(f"{host}:{port}: {error.strerror}; wanted a free UDP port") from None
