"""The control law and the timing of a plain station; the scripts beside it add MAVLink by another library.

`gcs bench --peers` starts each script with a scenario, a UDP port on loopback and the file for its figures.
"""

import json
import sys
import time  # noqa: TID251 - a station of its own, with its own clock
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from gains.core.arrays import FloatArray, IntArray
from gcs.plan.formation import plan_formation
from scenarios.files import load
from scenarios.schema import NS_PER_S, Scenario


class Order(NamedTuple):
    """The arguments of a station's script."""

    scenario: Scenario
    port: int
    out: Path


def ordered() -> Order:
    file, port, out = sys.argv[1:]
    return Order(load(Path(file)), int(port), Path(out))


class Law:
    """u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p from the newest states, whatever their age."""

    def __init__(self, scenario: Scenario) -> None:
        formation, gains = plan_formation(scenario), scenario.control.gains
        assert gains is not None
        self.system_ids = formation.system_ids
        self.states = np.full((len(self.system_ids), 4), np.nan)
        """Position and velocity, north and east, of each vehicle."""
        self._gains = gains
        self._ahead: IntArray = np.array(formation.model.predecessors)
        self._offset_m: FloatArray = formation.offset_ne_m
        self._nominal_m_s: FloatArray = np.array(scenario.nominal_velocity_at(0.0))

    def spacing_errors_m(self) -> FloatArray:
        """e_i^p (n, 2), zero for the leader."""
        position = self.states[:, :2]
        errors = position[self._ahead] - position + self._offset_m
        errors[self._ahead < 0] = 0.0
        return errors

    def commands(self) -> FloatArray:
        """Accelerations (n, 2)."""
        velocity_error = self.states[:, 2:] - self._nominal_m_s
        ahead = np.where(self._ahead[:, None] < 0, 0.0, velocity_error[self._ahead])
        return self._gains.K1 * velocity_error + self._gains.K2 * ahead + self._gains.K3 * self.spacing_errors_m()


def report(out: Path, lateness_s: Sequence[float] | FloatArray, due: int, used_s: float, error_m: float) -> None:
    """Write the lateness of the ticks flown, their share of those due, the processor time and the spacing error."""
    p50, p99 = np.percentile(lateness_s, [50, 99]).tolist()
    figures = {"late_p50_s": p50, "late_p99_s": p99, "flown": len(lateness_s) / due, "used_s": used_s}
    out.write_text(json.dumps(figures | {"error_m": error_m}), encoding="utf-8")


class Station(Protocol):
    """The MAVLink part of a plain station, by another library."""

    def start(self, telemetry_hz: float) -> None:
        """Send start commands until every vehicle has armed in GUIDED mode and reports its state."""
        ...

    def wait(self, until_ns: int) -> None:
        """Take telemetry until an instant of the monotonic clock."""
        ...

    def send(self, commands: Sequence[Sequence[float]]) -> None:
        """Send each vehicle its acceleration."""
        ...


def fly(station_of: Callable[[Law, int], Station]) -> None:
    """Fly the scenario for its duration with the station made for a law and a port, and report.

    A tick that falls due before the previous one has been sent is skipped.
    """
    order = ordered()
    law = Law(order.scenario)
    station = station_of(law, order.port)
    station.start(order.scenario.rates.telemetry_hz)
    rate_hz = order.scenario.rates.control_hz
    period_ns, ticks = round(NS_PER_S / rate_hz), round(order.scenario.duration_s * rate_hz)
    used_s, begun_ns, tick, late_s = time.process_time(), time.monotonic_ns(), 0, list[float]()
    while tick < ticks:
        due_ns = begun_ns + tick * period_ns
        station.wait(due_ns)
        station.send(law.commands().tolist())
        sent_ns = time.monotonic_ns()
        late_s.append((sent_ns - due_ns) / NS_PER_S)
        tick = max(tick + 1, (sent_ns - begun_ns) // period_ns)
    error_m = float(np.abs(law.spacing_errors_m()).max())
    report(order.out, late_s, ticks, time.process_time() - used_s, error_m)
