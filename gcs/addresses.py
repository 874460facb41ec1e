"""Addresses as a user gives them."""

import typer

from gcs.udp import StationSocket


def address(option: str, text: str) -> tuple[str, int]:
    """HOST:PORT as given to an option."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 <= int(port) < 65536:
        raise typer.BadParameter(f"{option}: read {text!r}, wanted HOST:PORT, as 127.0.0.1:14550")
    return host, int(port)


def listening(option: str, text: str) -> StationSocket:
    """A socket that listens at the HOST:PORT given to an option."""
    host, port = address(option, text)
    try:
        return StationSocket(host, port)
    except OSError as error:
        raise typer.BadParameter(f"{host}:{port}: {error.strerror}; wanted a free UDP port") from None
