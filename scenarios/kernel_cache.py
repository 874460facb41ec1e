"""The first call of a kernel, for `scenarios/kernel.py`: where Numba caches, and that no signal breaks into it."""

import signal
from typing import Any

from numba.core import event
from numba.core.caching import UserProvidedCacheLocator


class AnyClone(UserProvidedCacheLocator):
    """Numba's cache in a folder that its user names, but the same for copies of the source in other folders."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:  # noqa: ARG003
        return ""


class _Uninterrupted(event.Listener):
    """Defers the signals that end a command while Numba compiles: LLVM would lose the exception that they raise."""

    def __init__(self) -> None:
        self._depth = 0
        self._former: dict[int, Any] = {}
        self._came: list[int] = []

    def on_start(self, event: object) -> None:  # noqa: ARG002
        self._depth += 1
        if self._depth > 1:
            return
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            try:
                self._former[number] = signal.signal(number, lambda number, _: self._came.append(number))
            except ValueError:  # not the main thread, whose handlers alone run
                return

    def on_end(self, event: object) -> None:  # noqa: ARG002
        self._depth -= 1
        if self._depth:
            return
        while self._former:
            signal.signal(*self._former.popitem())
        while self._came:
            signal.raise_signal(self._came.pop())


event.register("numba:compile", _Uninterrupted())
