"""How a command ends early: by Ctrl-C, SIGTERM, or the SIGHUP of a closed terminal or a dropped SSH session.

By default all three end the process at once (`gcs.__main__`). Where resources must be closed first, they raise
KeyboardInterrupt (`raised`). In flight they become the reason to end the flight (`stop_signals`).
"""

import signal
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

FROM_TERMINAL = frozenset((signal.SIGINT, signal.SIGHUP))
"""The signals that a terminal sends to every process of a command."""


def ending_signals() -> list[signal.Signals]:
    """The signals that end a command. SIGHUP is left out if it is ignored, as under nohup, and stays ignored."""
    ending = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    return [number for number in ending if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN]


@contextmanager
def _handled(handler: Callable[[int, Any], Any]) -> Generator[None]:
    before = {number: signal.signal(number, handler) for number in ending_signals()}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def raised() -> Generator[None]:
    """While entered, the signals raise KeyboardInterrupt, so open contexts are closed before the process ends."""
    with _handled(signal.default_int_handler):
        yield


@contextmanager
def stop_signals() -> Generator[Callable[[], str]]:
    """While entered, the signals do not raise; the yielded function returns the first as a reason to stop, or ""."""
    asked: list[str] = []

    def on_signal(number: int, _: object) -> None:
        asked.append(f"interrupted: {signal.Signals(number).name}")

    with _handled(on_signal):
        yield lambda: asked[0] if asked else ""


@contextmanager
def held_back() -> Generator[None]:
    """While entered, terminal signals are blocked and stay pending; processes started meanwhile inherit the mask."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, FROM_TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
