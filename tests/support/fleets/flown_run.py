"""Runs as a flight leaves them, made in no time: vehicles in line whose spacing errors die away."""

from pathlib import Path

import numpy as np

from gcs.control.tick import TICK, Event, Mode, TickArray
from gcs.plan.design import Design
from gcs.runs.files import write_design
from gcs.runs.record import SCENARIO_FILE, RunWriter
from scenarios import files
from scenarios.networks import ids_of
from scenarios.schema import NominalVelocity, Scenario, Vehicle

DESIGN = Design(delay_margin_s=0.4, delay_margin_continuous_s=0.41)
SPEED_M_S = 50.0
PERIOD_S = 0.02


def line(count: int) -> Scenario:
    """A scenario of `count` vehicles in line, each 30 m behind and 40 m east of the one ahead."""
    ids = ids_of(count)[::-1]  # so that the scenario's order is not that of the system ids
    vehicles = tuple(
        Vehicle(
            system_id=ids[k],
            follows=None if k == 0 else ids[k - 1],
            offset_ne_m=None if k == 0 else (-30.0, 40.0),
            position_ne_m=(-30.0 * k, 40.0 * k),
            velocity_ne_m_s=(SPEED_M_S, 0.0),
        )
        for k in range(count)
    )
    velocity = (NominalVelocity(from_s=0.0, velocity_ne_m_s=(SPEED_M_S, 0.0)),)
    return Scenario(name=f"line{count}", seed=1, duration_s=20.0, vehicles=vehicles, nominal_velocity=velocity)


def ticks_of(scenario: Scenario, *, start_s: float, count: int, first: int = 0) -> TickArray:
    """Ticks of a flight in formation, shape (count, vehicles); each vehicle's state has another age."""
    vehicles = len(scenario.vehicles)
    column = np.arange(vehicles)
    age_s = 0.01 + 0.05 * column / vehicles
    ticks = np.zeros((count, vehicles), TICK)
    ticks["tick"] = first + np.arange(count)[:, np.newaxis]
    ticks["time_s"] = start_s + PERIOD_S * np.arange(count)[:, np.newaxis]
    ticks["due_ns"] = ticks["tick"] * 20_000_000
    ticks["sent_ns"] = ticks["due_ns"] + 300_000
    ticks["system_id"] = [vehicle.system_id for vehicle in scenario.vehicles]
    ticks["mode"] = Mode.NOMINAL
    ticks["delay_margin_s"] = 0.4
    ticks["telemetry_age_s"] = age_s
    positions_m = np.array([vehicle.position_ne_m for vehicle in scenario.vehicles])
    ticks["north_m"] = positions_m[:, 0] + SPEED_M_S * (ticks["time_s"] - age_s)
    ticks["east_m"] = positions_m[:, 1]
    ticks["down_m"] = -scenario.altitude_m
    ticks["velocity_north_m_s"] = SPEED_M_S
    error_m = (column + 1) * np.exp(-ticks["time_s"])
    ticks["spacing_error_north_m"] = np.where(column == 0, np.nan, 3 * error_m)
    ticks["spacing_error_east_m"] = np.where(column == 0, np.nan, 4 * error_m)
    ticks["down_delay_s"] = 0.02
    ticks["loop_delay_s"] = age_s + 0.02
    ticks["headroom"] = 1 - ticks["loop_delay_s"] / (DESIGN.delay_margin_s or np.inf)
    ticks["rtt_s"] = np.where(ticks["tick"] % 5 == 0, 0.05, np.nan)
    return ticks


def prepare(folder: Path, scenario: Scenario) -> RunWriter:
    """A run folder with its inputs, and the writer of its logs."""
    (folder / SCENARIO_FILE).write_text(files.dump(scenario), encoding="utf-8")
    write_design(folder, DESIGN)
    return RunWriter(folder)


def write_run(folder: Path, scenario: Scenario, ticks: TickArray) -> None:
    """A finished run of these ticks, with an event at the beginning and one at the end."""
    writer = prepare(folder, scenario)
    writer.event(Event(time_s=float(ticks["time_s"][0, 0]), kind="phase", text="connecting"))
    for rows in ticks:
        writer.tick(rows)
    writer.event(Event(time_s=float(ticks["time_s"][-1, 0]), kind="end", text="duration reached"))
    writer.close()
