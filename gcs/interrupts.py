"""How a command ends early: by Ctrl-C, SIGTERM, or the SIGHUP of a closed terminal or a dropped SSH session.

At first all three end the process at once (`gcs.__main__`). Where something must be closed on the way out they raise
KeyboardInterrupt (`raised`); in flight they become a reason to end it (`stop_signals`).
"""

import signal
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

FROM_TERMINAL = frozenset((signal.SIGINT, signal.SIGHUP))
"""A terminal sends these to every process of a command."""


def ending_signals() -> list[signal.Signals]:
    """The signals that end a command. Under nohup, SIGHUP is ignored and stays so."""
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
    """While entered, the signals raise KeyboardInterrupt, so that whatever is open is closed on the way out."""
    with _handled(signal.default_int_handler):
        yield


@contextmanager
def stop_signals() -> Generator[Callable[[], str]]:
    """While entered, the signals raise nothing: they become a reason to end the flight, and the vehicles hold."""
    asked: list[str] = []

    def on_signal(number: int, _: object) -> None:
        asked.append(f"interrupted: {signal.Signals(number).name}")

    with _handled(on_signal):
        yield lambda: asked[0] if asked else ""


@contextmanager
def held_back() -> Generator[None]:
    """While entered, signals from a terminal wait; processes started meanwhile block them until they unblock them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, FROM_TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
