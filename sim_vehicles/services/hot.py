"""State of a vehicle that changes with every message, as one record per vehicle, shared by kernels and objects."""

from typing import NamedTuple

import numpy as np

from scenarios.kernel import Columns, Records
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.frames import GLOBAL_POSITION, HEARTBEAT, LOCAL_POSITION, TIMESYNC

NOBODY = -1
"""Stands for the station's system id where there is no station."""
NEVER_ASKED = -1
"""Stands for the `ts1` of the newest TIMESYNC request before there is one."""

VEHICLE = np.dtype(
    [
        ("system_id", "i8"), ("wire_id", "i8"),
        ("plain", "?"),  # whether kernels may run its common events: `sim_vehicles.vehicles.plain`
        ("pushed", "?"),  # whether a disturbance pushes it: the craft then moves it before each event that kernels run
        ("acts_ns", "i8"),  # when it next acts if nothing arrives
        ("sequence", "i8"),  # number of the next frame
        ("clock_start_ns", "i8"), ("clock_offset_ns", "i8"), ("clock_drift_ppb", "i8"),  # BootClock
        # Schedule: the periodic reports in REPORTS, the next of them, and the next message of any other kind
        ("due_ns", "i8", (4,)), ("due_ms", "i8", (4,)), ("number", "i8", (4,)), ("interval_us", "i8", (4,)),
        ("report", "i8"), ("report_ns", "i8"),
        ("other_ns", "i8"),
        ("asked_ts1", "i8"),  # of its newest TIMESYNC request
        # Authority
        ("station", "i8"), ("heard_ns", "i8"), ("commanded_ns", "i8"),
        # FlightMode
        ("armed", "?"), ("flying", "?"), ("mode", "i8"), ("stopped", "i8"), ("deadline_ns", "i8"),
        ("setpoint_ns", "i8"), ("setpoint_timeout_ns", "i8"), ("heartbeat_ns", "i8"), ("heartbeat_timeout_ns", "i8"),
        # the double integrator: its State at a time, its Command and its Bounds
        ("state_ns", "i8"), ("state", "f8", (4,)), ("command", "f8", (5,)), ("bounds", "f8", (4,)),
        ("altitude_m", "f8"),
        # counts that have not been added to the vehicle's counters yet
        ("setpoints", "i8"), ("heartbeats", "i8"), ("timesync_requests", "i8"), ("timesync_replies", "i8"),
    ],
    align=True,
)  # fmt: skip
REPORTS = HEARTBEAT, LOCAL_POSITION, GLOBAL_POSITION, TIMESYNC
"""Messages that vehicles send unasked; those due at the same time are sent in this order."""
COUNTED = ("setpoints", "heartbeats", "timesync_requests", "timesync_replies")


class Place(NamedTuple):
    """Location of a vehicle's record."""

    vehicles: Records
    columns: Columns
    """Columns of `vehicles`."""
    row: int


def new_vehicles(n: int) -> Records:
    """Initial records of `VEHICLE` for n vehicles."""
    vehicles = np.zeros(n, VEHICLE)
    vehicles["station"], vehicles["asked_ts1"] = NOBODY, NEVER_ASKED
    for name in ("acts_ns", "due_ns", "report_ns", "other_ns", "deadline_ns"):
        vehicles[name] = NEVER_NS
    return vehicles


def new_place() -> Place:
    """The place of a vehicle on its own."""
    vehicles = new_vehicles(1)
    return Place(vehicles, Columns(vehicles), 0)
