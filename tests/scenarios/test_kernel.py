"""Kernels that count no array references are returned no new arrays; how kernels are cached and compiled."""

import gc
import os
import pkgutil
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from gains.core.arrays import FloatArray
from scenarios import kernel as kernel_module
from scenarios.kernel import array_kernel, kernel

NUMBERS = {type(None), bool, int, float}


def kernels() -> list[Any]:
    gc.unfreeze()  # a command that an earlier test ran in this process has frozen them; frozen objects are not listed
    return [each for each in gc.get_objects() if type(each).__name__ == "_Kernel"]


def lost_arrays(caller: Any) -> Iterator[str]:
    """The kernels whose new arrays would be lost in one that calls them."""
    for called in () if caller._makes_arrays else caller._called():
        returned = get_type_hints(called._function)["return"]
        if called._makes_arrays and not {*(get_args(returned) or (returned,))} <= NUMBERS:
            yield f"{caller._name} calls {called._name}"


def test_no_arrays_are_returned_to_kernels_that_count_no_references() -> None:
    for package in ("gcs", "scenarios", "sim_vehicles"):
        for module in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
            import_module(module.name)
    ours = [each for each in kernels() if each._name.startswith(("gcs.", "scenarios.", "sim_vehicles."))]
    assert len(ours) > 100
    assert [lost for each in ours for lost in lost_arrays(each)] == []


@array_kernel
def zeros(n: int) -> FloatArray:
    return np.zeros(n)


@array_kernel
def size_of_zeros(n: int) -> int:
    return len(zeros(n))


@kernel
def wrong(n: int) -> int:
    return len(zeros(n))


@kernel
def right(n: int) -> int:
    return size_of_zeros(n)


@pytest.mark.parametrize(("caller", "lost"), [(wrong, 1), (right, 0), (size_of_zeros, 0)])
def test_a_kernel_that_would_lose_arrays_is_found(caller: Any, lost: int) -> None:
    assert len([*lost_arrays(caller)]) == lost


def loaded(file: Path) -> Any:
    spec = spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_second_copy_of_the_same_source_compiles_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from numba.core import config

    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    text = "from scenarios.kernel import kernel\n\n\n@kernel\ndef square(n: int) -> int:\n    return n * n\n"
    known: list[int] = []
    announced: list[str] = []
    for name, source in (("first", text), ("second", text), ("changed", text.replace("n * n", "n * n + 1"))):
        (tmp_path / name).mkdir()
        file = tmp_path / name / "square.py"
        file.write_text(source, encoding="utf-8")
        square = loaded(file).square
        monkeypatch.setattr(kernel_module, "before_compiling", [partial(announced.append, name)])
        assert square(3) == 9 + (name == "changed")
        known.append(sum(square._compiled.stats.cache_hits.values()))
    assert known == [0, 1, 0]
    assert announced == ["first", "changed"]


def test_threads_calling_kernels_for_the_first_time_find_one_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a worker of a cluster with several threads."""
    from numba.core import config

    settings: Any = config
    monkeypatch.setattr(settings, "CACHE_DIR", str(tmp_path))
    file = tmp_path / "several.py"
    head = "from scenarios.kernel import kernel\n"
    file.write_text(head + "".join(f"\n\n@kernel\ndef plus_{k}(n):\n    return n + {k}\n" for k in range(32)))
    several = loaded(file)

    def added(k: int) -> int:
        return getattr(several, f"plus_{k}")(1)

    with ThreadPoolExecutor(8) as pool:
        assert [*pool.map(added, range(32))] == [*range(1, 33)]
    assert str(tmp_path) == settings.CACHE_DIR
    folders = {path.parent for path in tmp_path.rglob("*.nbi")}
    assert len(folders) == 32


@pytest.mark.parametrize(
    "changed", [("Pair", "y: int", "x: int"), ("Renamed", "x: int", "y: int")], ids=["reordered", "renamed"]
)
def test_a_kernel_is_recompiled_after_its_tuple_changed_elsewhere(
    changed: tuple[str, str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel's file says nothing of the tuple, and the class that was cached is gone, as after an update."""
    from numba.core import config

    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    kernels = tmp_path / "difference.py"
    kernels.write_text(
        "from scenarios.kernel import kernel\n\n\n@kernel\ndef difference(of):\n    return of.x - of.y\n"
    )
    pairs = tmp_path / "pairs_of_numbers.py"
    for name, *fields in (("Pair", "x: int", "y: int"), changed):
        lines = ["from typing import NamedTuple", f"class {name}(NamedTuple):", *(f"    {field}" for field in fields)]
        pairs.write_text("\n".join(lines))
        module = loaded(pairs)
        monkeypatch.setitem(sys.modules, pairs.stem, module)
        pair = getattr(module, name)(x=5, y=3)
        assert loaded(kernels).difference(pair) == 2


def test_a_signal_waits_until_a_kernel_is_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from numba.core import config, event

    class Interrupted(event.Listener):
        def on_start(self, event: object) -> None:  # noqa: ARG002
            if not order:
                os.kill(os.getpid(), signal.SIGTERM)
            order.append("compiles")

        def on_end(self, event: object) -> None: ...

    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    file = tmp_path / "cube.py"
    file.write_text("from scenarios.kernel import kernel\n\n\n@kernel\ndef square(n: int) -> int:\n    return n**3\n")
    order: list[str] = []

    def handled(number: int, frame: object) -> None:
        order.append("signal")

    former = signal.signal(signal.SIGTERM, handled)
    try:
        with event.install_listener("numba:run_pass", Interrupted()):
            assert loaded(file).square(3) == 27
    finally:
        signal.signal(signal.SIGTERM, former)
    assert order.count("signal") == 1
    assert order.index("signal") == len(order) - 1 > 1
