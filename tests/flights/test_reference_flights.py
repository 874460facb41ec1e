"""Reference flights: short scenarios in virtual time, known by the hash of their tick log and by where they end.

If one changes, flights have changed. If that was the purpose, print the new references with

    .venv/bin/python tests/flights/test_reference_flights.py

and put them below, in the commit that changed them.

With its gains given, a flight is the same to the last bit in any process and on older and newer x86 processors, which
is a test of its own. Sines and powers may still be rounded otherwise by another C library or kind of processor. So the
hash is over what is counted: ticks, times, modes, which states were used, which datagrams came. Every changed rule,
draw or instant shows in it. Where the flight ends is compared as numbers, to `END_TOLERANCE`.
"""

import hashlib
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from gcs.control.tick import TickArray
from gcs.drive.flown import fly_plan
from gcs.plan.planner import flight_plan
from gcs.stress.axes import at_coordinates
from scenarios.files import load
from scenarios.schema import Control, FixedGains, Scenario
from tests.support.paths import SCENARIOS

DURATION_S = 3.0
COUNTED = (
    "tick",
    "due_ns",
    "sent_ns",
    "key_ms",
    "system_id",
    "mode",
    "commanded",
    "sample_boot_ms",
    "received",
    "lost",
    "late",
    "duplicate",
)
MEASURED = ("north_m", "east_m", "velocity_north_m_s", "velocity_east_m_s")
END_TOLERANCE = 1e-3
"""In m and m/s: a hundred float32 steps of telemetry."""


@dataclass(frozen=True)
class Reference:
    sha256: str
    end: tuple[tuple[float, ...], ...]
    """The last state of each vehicle that the station knows, in the order of the formation: north, east, velocities."""


REFERENCES: dict[str, Reference] = {
    "chain3, 40 ms": Reference(
        sha256="cec1abbe5aba3859266acb2e3f4373c4178de674d5e6e3b22576e827b91c609f",
        end=(
            (273.30994, 0.0, 91.43999, 0.0),
            (151.68394, 121.91996, 91.43271, 0.00527),
            (29.15144, 243.82384, 91.4005, 0.02628),
        ),
    ),
    "chain3, above the margin": Reference(
        sha256="99cca8bbeaf4e4c62ac0262d174c83bb9d4a28f7902e1c785d3c5bc6bba907cf",
        end=(
            (273.31076, 0.0, 91.43999, 0.0),
            (150.38237, 122.58942, 91.79482, 0.05114),
            (33.61743, 241.04831, 88.52953, 1.07321),
        ),
    ),
    "triangle5_scattered": Reference(
        sha256="dfc5a4e78bcec929c74cdd9730f943e4f1471889f3f5415d2fbb847faf47ceb5",
        end=(
            (272.09079, 2.70083, 91.43998, 3e-05),
            (153.53915, 119.05698, 112.19264, 1.27884),
            (148.93228, -116.2409, 77.56939, -29.97818),
            (26.05394, 264.2114, 56.72668, 21.87412),
            (17.69178, -224.83054, 126.39787, 16.64729),
        ),
    ),
    "triangle5, jitter and loss": Reference(
        sha256="166d36b0f08a02ca3279d19444e12d1c9ebff8c7a90d4fba99a7bb65ce9b8ac2",
        end=(
            (273.81363, 0.0, 91.44, 0.0),
            (151.82185, 121.92107, 91.445, -0.00178),
            (152.57901, -121.91902, 91.44037, -0.00161),
            (30.61367, 243.83429, 91.38332, 0.03442),
            (29.69437, -243.84488, 91.48491, 0.02838),
        ),
    ),
    "thesis_delay": Reference(
        sha256="496a2b44830be26fa215f2db8fd1c2238f272b8013ec457e9fa089e69e93d9f0",
        end=(
            (274.18597, 0.012, 91.48225, -0.02999),
            (150.89677, 121.90758, 91.44798, -0.00975),
            (29.98249, 243.79694, 91.41158, 0.04977),
        ),
    ),
}


def scenario(name: str) -> Scenario:
    """The reference scenario of a name."""
    file, changes = {
        "chain3, 40 ms": ("chain3", {}),
        "chain3, above the margin": ("chain3", {"delay": 0.5}),
        "triangle5_scattered": ("triangle5_scattered", {}),
        "triangle5, jitter and loss": ("triangle5", {"delay": 0.1, "jitter": 0.01, "loss": 0.05}),
        "thesis_delay": ("thesis_delay", {}),
    }[name]
    loaded = load(SCENARIOS / f"{file}.toml").model_copy(update={"duration_s": DURATION_S})
    if not loaded.control.blocks:
        loaded = loaded.model_copy(update={"control": Control(gains=FixedGains(K1=-3.4, K2=0.6, K3=5.6))})
    return at_coordinates(loaded, changes)


def flown(name: str) -> TickArray:
    _, plan = flight_plan(scenario(name))
    return fly_plan(plan).ticks


def reference_of(ticks: TickArray) -> Reference:
    """The hash of what is counted, and the end of what is measured."""
    digest = hashlib.sha256()
    for column in COUNTED:
        kept = np.uint8 if column == "system_id" else ticks[column].dtype  # of one byte when the hashes were made
        digest.update(ticks[column].astype(kept).tobytes())
    vehicles = len(np.unique(ticks["system_id"]))
    end = tuple(tuple(round(float(row[name]), 5) for name in MEASURED) for row in ticks[-vehicles:])
    return Reference(digest.hexdigest(), end)


@pytest.mark.parametrize("name", REFERENCES)
def test_flight_is_the_reference_flight(name: str) -> None:
    found, known = reference_of(flown(name)), REFERENCES[name]
    assert np.array(found.end) == pytest.approx(np.array(known.end), abs=END_TOLERANCE)
    assert found.sha256 == known.sha256


@pytest.mark.parametrize("changes", [{"seed": 2}, {"duration_s": DURATION_S + 0.02}])
def test_reference_sees_another_seed_and_another_tick(changes: dict[str, Any]) -> None:
    _, plan = flight_plan(scenario("triangle5, jitter and loss").model_copy(update=changes))
    assert reference_of(fly_plan(plan).ticks).sha256 != REFERENCES["triangle5, jitter and loss"].sha256


def test_the_reference_sees_gains_that_differ_by_a_thousandth() -> None:
    _, plan = flight_plan(scenario("chain3, above the margin"))
    end = reference_of(fly_plan(replace(plan, gain=1.001 * plan.gain)).ticks).end
    known = REFERENCES["chain3, above the margin"].end
    assert float(np.abs(np.array(end) - np.array(known)).max()) > 2.0 * END_TOLERANCE


OLDER_PROCESSOR = {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"}
"""Sums of products in another order, no fused multiplications: what BLAS and numpy do on a processor of 2009."""


@pytest.mark.parametrize("other", [{"PYTHONHASHSEED": "12345"}, OLDER_PROCESSOR])
def test_another_process_flies_the_same_to_the_last_bit(other: dict[str, str]) -> None:
    """Another hash seed changes the order of sets, another processor that of sums; nothing flown may depend on them."""
    name = "triangle5, jitter and loss"
    here = hashlib.sha256(flown(name).tobytes()).hexdigest()
    environment = {**os.environ, **other}
    command = [sys.executable, __file__, "--bits", name]
    there = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.strip()
    assert there == here


def print_references() -> None:
    """Print all references as Python source, to be put above."""
    for name in REFERENCES:
        reference = reference_of(flown(name))
        print(f'    "{name}": Reference(\n        sha256="{reference.sha256}",\n        end=(')
        for row in reference.end:
            print(f"            {row},")
        print("        ),\n    ),")


if __name__ == "__main__":
    if "--bits" in sys.argv:
        print(hashlib.sha256(flown(sys.argv[-1]).tobytes()).hexdigest())
    else:
        print_references()
