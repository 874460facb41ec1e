"""Kernels: functions that run for every frame of every vehicle, compiled by Numba, and the records they work on.

A kernel works on numpy arrays of records, one for each vehicle, and gives the same bits as Python would. It is compiled
at its first call, and cached on disk for later processes and for other copies of the source. The cache is valid until
the kernel's file or a kernel, number or tuple that it uses changes. Numba is not even imported before the first call:
most commands fly nothing.
"""

import hashlib
import os
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from types import FunctionType
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import numpy as np

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")
P = ParamSpec("P")
Record = Any
"""In a kernel, one record of a structured array: its fields are attributes, and changes reach the array."""
Records = Any
"""A structured array."""
Array = Any
"""In a kernel, an array: its elements are numbers."""
int64: Any = np.int64


def kernel(function: F) -> F:
    """The function, compiled when it is first called. It must not raise: a datagram may hold anything.

    It makes no arrays, so references to arrays are not counted: counting would take most of its time.
    """
    compiled: Any = _Kernel(function, makes_arrays=False)
    return compiled


def array_kernel(function: F) -> F:
    """As `kernel`, for a function that makes arrays, or calls one that returns new ones."""
    compiled: Any = _Kernel(function, makes_arrays=True)
    return compiled


def at_row(run: Callable[Concatenate[Record, P], T]) -> Callable[Concatenate[Records, int, P], T]:
    """A kernel as Python calls it: with an array of records and a row in place of the record that it works on.

    Each is a copy of `_at_row` whose global `_run` is its kernel, as the compiler knows kernels only as globals.
    """
    inner: Any = run
    outer: Any = FunctionType(_at_row.__code__, {"_run": run}, "_at_row")
    outer.__module__, _, name = inner._name.rpartition(".")
    outer.__qualname__ = f"{name}_at"
    return kernel(outer)


_run: Any = None


def _at_row(records: Records, row: int, *rest: Any) -> Any:
    return _run(records[row], *rest)


before_compiling: list[Callable[[], None]] = []
"""Called and removed as soon as a kernel has to be compiled because it is in no cache."""


def _announce() -> None:
    while before_compiling:
        before_compiling.pop()()


class _Kernel:
    def __init__(self, function: Callable[..., Any], *, makes_arrays: bool) -> None:
        self._function = function
        self._makes_arrays = makes_arrays
        self._name = f"{function.__module__}.{function.__qualname__}"
        self.__doc__ = function.__doc__
        self._compiled: Callable[..., Any] | None = None

    def __call__(self, *arguments: Any) -> Any:
        return (self._compiled or self._compile())(*arguments)

    @property
    def _numba_type_(self) -> Any:
        """The type by which Numba knows a function that a kernel calls."""
        return self._for_kernels._numba_type_

    @cached_property
    def _for_kernels(self) -> Any:
        """The dispatcher for kernels: Python's if compiled, else one without Python's wrapper, a sixth of the work."""
        return self._compiled or self._dispatcher(for_python=False)

    def _compile(self) -> Callable[..., Any]:
        self._compiled = compiled = self._dispatcher(for_python=True)
        return compiled

    def _dispatcher(self, *, for_python: bool) -> Any:
        """Numba's dispatcher, which compiles the function at the first call with each combination of argument types.

        The lock is for threads: the cache folder is a setting of the process.
        """
        import numba
        from numba.core import config
        from numba.core.compiler_lock import global_compiler_lock

        from scenarios import kernel_cache

        settings: Any = config
        compiler: Any = numba
        lock: Any = global_compiler_lock
        with lock:
            folder, before = _cache(settings.CACHE_DIR), (settings.CACHE_DIR, settings.CACHE_LOCATOR_CLASSES)
            # a cache folder for each state of the source: Numba's own index does not see what a kernel calls
            settings.CACHE_DIR = (
                ""
                if folder is None
                else str(folder / f"{self._stamp}={settings.BOUNDSCHECK}{self._makes_arrays:d}{for_python:d}")
            )
            settings.CACHE_LOCATOR_CLASSES = "scenarios.kernel_cache.AnyClone"
            try:
                # inlined, as a call that passes a tuple copies every array in it: flights take an eighth less time, and
                # compilation a third more; bounds are checked in tests only
                compiled = compiler.njit(
                    _nrt=self._makes_arrays,
                    forceinline=not settings.BOUNDSCHECK,
                    no_cfunc_wrapper=True,
                    no_cpython_wrapper=not for_python,
                )(self._function)
                if folder is None:
                    _announce()
                else:
                    compiled._cache = kernel_cache.KernelCache(self._function, _announce)
                return compiled
            finally:
                settings.CACHE_DIR, settings.CACHE_LOCATOR_CLASSES = before

    def _called(self) -> "list[_Kernel]":
        names, known = self._function.__code__.co_names, self._function.__globals__
        return [known[name] for name in names if isinstance(known.get(name), _Kernel)]

    @cached_property
    def _stamp(self) -> str:
        """A hash of the function's source, of that of all kernels it calls, and of the constants that these use."""
        reached: dict[str, bytes] = {}
        left = [self]
        while left:
            one = left.pop()
            function = one._function
            reached[one._name] = Path(function.__code__.co_filename).read_bytes()
            left += [called for called in one._called() if called._name not in reached]
            for name in function.__code__.co_names:
                value = function.__globals__.get(name)
                if isinstance(value, (bool, int, float, tuple)):
                    reached[f"{function.__module__}.{name}"] = repr(value).encode()
        parts = [self._name.encode(), *(name.encode() + reached[name] for name in sorted(reached))]
        return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


def _cache(wanted: str) -> Path | None:
    """The folder in which compiled kernels are cached; None if there can be none."""
    try:
        folder = Path(wanted or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "formation-gcs"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
        return None
    return folder if os.access(folder, os.W_OK) else None


class Columns(dict[str, Any]):
    """The fields of a structured array by name: reading a number in one takes 40 ns, in a record 500 ns."""

    def __init__(self, records: Records) -> None:
        super().__init__()
        self._records = records

    def __missing__(self, name: str) -> Any:
        self[name] = column = memoryview(self._records[name])
        return column


class Cell(Generic[T]):
    """A descriptor: the attribute is a number in row `_row` of the `_columns` of its object.

    The column has the attribute's name, without a leading underscore. With `unknown`, that number stands for None.
    """

    def __init__(self, unknown: object = None) -> None:
        self._unknown = unknown

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name.removeprefix("_")

    def __get__(self, of: Any, owner: type) -> T:
        value: Any = of._columns[self._name][of._row]
        none: Any = None
        return none if self._unknown is not None and value == self._unknown else value

    def __set__(self, of: Any, value: T) -> None:
        column: Any = of._columns[self._name]
        column[of._row] = self._unknown if value is None else value
