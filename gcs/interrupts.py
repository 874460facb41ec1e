"""Ctrl-C where it has something to bring to an end first, and where it is for another process to answer."""

import signal
from collections.abc import Generator
from contextlib import contextmanager

EXIT_INTERRUPTED = 130


@contextmanager
def raised() -> Generator[None]:
    """While entered, Ctrl-C is a KeyboardInterrupt, so that what is open is closed on the way out."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def held_back() -> Generator[None]:
    """While entered, Ctrl-C waits; processes started meanwhile do not get it before they ask for it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
