"""What `scenarios/kernel.py` changes in Numba: how kernels are cached, and that signals wait for a compilation."""

import signal
from collections.abc import Callable
from typing import Any

from numba.core import event, types
from numba.core.caching import FunctionCache, UserProvidedCacheLocator


class AnyClone(UserProvidedCacheLocator):
    """Places Numba's cache in a folder that the caller names, the same for all copies of the source."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:  # noqa: ARG003
        return ""


class KernelCache(FunctionCache):
    """Numba's cache for a function, with an index that names the fields of tuples.

    Compiled code knows them by their order, which may have changed since. The index holds text, not classes, because a
    class may no longer exist. `before_compiling` is called if the cache has no code for the arguments.
    """

    def __init__(self, function: Callable[..., Any], before_compiling: Callable[[], None]) -> None:
        super().__init__(function)
        self._before_compiling = before_compiling

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        if (found := super().load_overload(sig, target_context)) is None:
            self._before_compiling()
        return found

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (*map(_described, sig), *super()._index_key(sig, codegen)[1:])


def _described(kind: Any) -> str:
    """A type's name; of a named tuple, also its fields, and of a handle, those of its tuple."""
    if isinstance(kind, types.StructRef):
        return f"{kind} {[*map(_described, kind.field_dict.values())]}"
    if isinstance(kind, types.BaseTuple):
        inner: Any = kind
        return f"{kind} {getattr(kind, 'fields', '')} {[*map(_described, inner.types)]}"
    return str(kind)


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
