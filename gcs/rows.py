"""Filling the rows of the tick record from what the station holds."""

import numpy as np
from numpy.typing import NDArray

from gcs.control import FormationControl
from gcs.record import TickArray
from gcs.vehicle import RemoteVehicle


def write_control(rows: TickArray, control: FormationControl, commanded: NDArray[np.bool_]) -> None:
    """States, errors and commands; a command that is not sent is NaN."""
    rows["commanded"] = commanded
    rows["sample_ns"] = np.maximum(control.sample_ns, 0)
    rows["north_m"], rows["east_m"] = control.position_m.T
    rows["velocity_north_m_s"], rows["velocity_east_m_s"] = control.velocity_m_s.T
    rows["spacing_error_north_m"], rows["spacing_error_east_m"] = control.spacing_error_m.T
    rows["velocity_error_north_m_s"], rows["velocity_error_east_m_s"] = control.velocity_error_m_s.T
    command = np.where(commanded[:, None], control.command_m_s2, np.nan)
    rows["command_north_m_s2"], rows["command_east_m_s2"] = command.T


def write_links(rows: TickArray, vehicles: list[RemoteVehicle]) -> None:
    """Delays, clocks and counts of each vehicle's link; NaN where nothing is known yet."""
    clocks = [vehicle.clock for vehicle in vehicles]
    rows["down_delay_s"] = [np.nan if c.down_ns is None else c.down_ns * 1e-9 for c in clocks]
    known = [c.estimate if c.estimate.samples else None for c in clocks]
    rows["clock_offset_s"] = [np.nan if e is None else e.offset_ns * 1e-9 for e in known]
    rows["clock_offset_bound_s"] = [np.nan if e is None else e.bound_ns * 1e-9 for e in known]
    for name in ("received", "lost", "late", "duplicate"):
        rows[name] = [getattr(vehicle.frames, name) for vehicle in vehicles]
