"""The time of each stage of a flight in virtual time, beside the least that whole arrays would take for the same.

`python -m docs.generate.stages` flies 250 vehicles and samples the running module a thousand times a second. The
floor is measured with arrays over all vehicles that do only the arithmetic: no vehicle has an object.
"""

import argparse
import json
import signal
import time  # noqa: TID251 - run time is what is measured
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from docs.generate.blocks import ROOT, table
from docs.generate.runner import Runner
from gcs.drive.lockstep import START_NS, Sent, Vehicles, fly_lockstep, prepare, vehicles_of
from gcs.link import mavlink
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from gcs.studies.benchmark import position_frames, pymavlink_parse_s, with_vehicles, without_solver
from scenarios.files import load

COMMAND = "python -m docs.generate.stages"
_VEHICLES, _SECONDS, _EVERY_S = 250, 10.0, 0.997e-3
_STAGES = {
    "station: datagrams in": ("gcs/station/reception", "gcs/link/", "gcs/autopilot/"),
    "station: monitor, law, set-points out": ("gcs/station/station", "gcs/station/monitor", "gcs/control/"),
    "station: breakage, tick record": ("gcs/station/",),
    "passing on": ("gcs/", "gains/", "docs/"),
    "vehicles and links": ("sim_vehicles/", "scenarios/"),
}
"""The modules of each stage; the first match counts. A kernel counts for the module that calls it."""


@dataclass
class _StepByStep:
    """Vehicles that are stepped one call at a time, so that no kernel runs their steps together with the station's."""

    vehicles: Vehicles

    def step(self, received: Sent, now_ns: int) -> Sent:
        return self.vehicles.step(received, now_ns)


def _crc_table() -> Any:
    """The checksum's remainder for each byte."""
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ 0x8408, table >> 1)
    return table


_CRC = _crc_table()


def stages(runner: Runner) -> str:
    """A row for each stage, with its time for a vehicle and a tick."""
    found = runner.json(COMMAND)
    rows = [(stage, f"{taken:.2f}") for stage, taken in found["stages_us"].items()]
    whole = sum(found["stages_us"].values())
    rows.append(("whole", f"{whole:.2f}"))
    return (
        f"{table(('stage', 'µs for a vehicle and tick'), rows)}\n\n"
        f"So a processor flies {1e6 / (50.0 * whole):.0f} vehicle-seconds in a second. The same arithmetic takes "
        f"{found['floor_us']:.2f} µs over whole arrays: checksums, decoding and encoding at both ends, the law, the "
        "motion, without an object for a vehicle or a frame."
    )


def _sampled() -> tuple[Counter[str], float]:
    """Samples of a flight's processor time by stage, and that time for a vehicle and tick."""
    flown = with_vehicles(load(ROOT / "scenarios" / "triangle5.toml"), _VEHICLES)
    _, plan = flight_plan(without_solver(flown, _SECONDS))
    seen: Counter[str] = Counter()

    def look(_: int, frame: FrameType | None) -> None:
        while frame is not None:
            name = frame.f_code.co_filename
            if name.startswith(str(ROOT)) and ".venv" not in name and not name.endswith("scenarios/kernel.py"):
                seen[_stage(str(Path(name).relative_to(ROOT)))] += 1
                return
            frame = frame.f_back

    prepare(plan)
    station, vehicles = Station(plan, start_ns=START_NS), _StepByStep(vehicles_of(plan.scenario))
    signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, _EVERY_S, _EVERY_S)
    begun_s = time.process_time()
    ticks = sum(1 for _ in fly_lockstep(plan, station=station, vehicles=vehicles))
    used_s = time.process_time() - begun_s
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    return seen, used_s / ticks / _VEHICLES


def _stage(path: str) -> str:
    return next(stage for stage, modules in _STAGES.items() if path.startswith(modules))


def _checksums(frames: Any, msg_id: int) -> Any:
    """The checksums of equally long frames (n, bytes), computed for all n at once."""
    crc = np.full(len(frames), 0xFFFF, np.uint16)
    extra = np.full(len(frames), mavlink.CRC_EXTRA[msg_id][0], np.uint8)
    for byte in (*frames[:, 1:-2].T, extra):
        crc = crc >> 8 ^ _CRC[(crc ^ byte) & 0xFF]
    return crc


def _floor_s() -> float:
    """The time of the arithmetic for a vehicle and tick, over arrays of all vehicles."""
    data = position_frames(_VEHICLES)
    position = np.dtype([("header", "V10"), ("boot_ms", "<u4"), ("state", "<f4", 6), ("crc", "<u2")])
    parsed = np.frombuffer(b"".join(data), position)
    assert np.array_equal(_checksums(np.array([*map(list, data)], np.uint8), mavlink.LOCAL_POSITION_NED), parsed["crc"])
    command = np.dtype([("header", "V10"), ("boot_ms", "<u4"), ("fields", "<f4", 11), ("end", "V5"), ("crc", "<u2")])
    state, before = np.random.default_rng(1).normal(size=(2, _VEHICLES, 4))
    gains, ahead = np.ones((_VEHICLES, 2, 4)), np.maximum(np.arange(_VEHICLES) - 1, 0)
    yaw, speed = np.zeros(_VEHICLES), np.ones(_VEHICLES)

    def decode() -> object:
        frames = np.frombuffer(b"".join(data), np.uint8).reshape(_VEHICLES, -1)
        good = _checksums(frames, mavlink.LOCAL_POSITION_NED) == frames[:, -2:].copy().view("<u2")[:, 0]
        return np.isfinite(parsed["state"]).all(axis=1) & good

    def encode() -> object:
        frames = np.zeros(_VEHICLES, command)
        frames["fields"][:, 6:8] = state[:, :2]
        frames["crc"] = _checksums(frames.view(np.uint8).reshape(_VEHICLES, -1), mavlink.SET_POSITION_TARGET_LOCAL_NED)
        whole, size = frames.tobytes(), command.itemsize
        return [whole[at : at + size] for at in range(0, len(whole), size)]

    def law() -> object:
        x = np.linspace(0.1, 0.9, _VEHICLES)[:, None]
        rise = state - before
        at_once = before + x * (rise + x * (3.0 * rise + x * (state - 2.0 * rise)))
        return np.einsum("nij,nj->ni", gains, at_once[ahead] - state)

    def motion() -> object:
        cosine, sine = np.cos(yaw), np.sin(yaw)
        along, across = speed + cosine * state[:, 0], cosine * state[:, 1] - sine * state[:, 0]
        return yaw + np.arctan2(across, along), np.hypot(along, across)

    both = _least_s(decode) + _least_s(encode)
    return 2.0 * both + _least_s(law) + 2.0 * _least_s(motion)  # to each set-point and to each report


def _least_s(work: Callable[[], object]) -> float:
    taken: list[float] = []
    for _ in range(200):
        begun_s = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begun_s)
    return min(taken) / _VEHICLES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON and nothing else")
    parser.parse_args()
    seen, whole_s = _sampled()
    found = {
        "stages_us": {stage: 1e6 * whole_s * seen[stage] / seen.total() for stage in _STAGES},
        "floor_us": 1e6 * _floor_s(),
        "pymavlink_parse_us": 1e6 * pymavlink_parse_s(position_frames(_VEHICLES)) / _VEHICLES,
    }
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
