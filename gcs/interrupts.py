"""How a command ends before its time: Ctrl-C, SIGTERM, and SIGHUP, which a closed terminal or a dropped SSH sends.

At first all three end the process at once with one line (`end_at_once`). Where something has to be closed on the way
out they raise KeyboardInterrupt (`raised`); in flight they become a reason to end it (`stop_signals`).
"""

import contextlib
import os
import signal
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

EXIT_INTERRUPTED = 130
FROM_TERMINAL = frozenset((signal.SIGINT, signal.SIGHUP))
"""A terminal sends these to all processes of a command."""


def _signals() -> list[signal.Signals]:
    """Those that end a command. Under nohup, SIGHUP is ignored and stays so."""
    ending = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    return [number for number in ending if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN]


@contextmanager
def _handled(handler: Callable[[int, Any], Any]) -> Generator[None]:
    before = {number: signal.signal(number, handler) for number in _signals()}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


def end_at_once() -> None:
    """From now on the signals end this process with one line; for before anything is open."""

    def end(*_: object) -> None:
        with contextlib.suppress(OSError):  # the terminal may have gone
            os.write(2, b"interrupted\n")
        os._exit(EXIT_INTERRUPTED)

    for number in _signals():
        signal.signal(number, end)


@contextmanager
def raised() -> Generator[None]:
    """While entered, the signals are a KeyboardInterrupt, so that what is open is closed on the way out."""
    with _handled(signal.default_int_handler):
        yield


@contextmanager
def stop_signals() -> Generator[Callable[[], str]]:
    """While entered, the signals raise nothing: they become a reason to end the flight, vehicles holding."""
    asked: list[str] = []

    def on_signal(number: int, _: object) -> None:
        asked.append(f"interrupted: {signal.Signals(number).name}")

    with _handled(on_signal):
        yield lambda: asked[0] if asked else ""


@contextmanager
def held_back() -> Generator[None]:
    """While entered, what a terminal sends waits; processes started meanwhile do not get it before they ask for it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, FROM_TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
