"""State of a vehicle that changes with every message, as one record per vehicle, shared by kernels and objects."""

from typing import NamedTuple

import numpy as np

from scenarios.kernel import Columns, Records
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.frames import ARDUPILOT, GLOBAL_POSITION, HEARTBEAT, LOCAL_POSITION, TIMESYNC

NOBODY = -1
"""Stands for the station's system id where there is no station."""
NEVER_ASKED = -1
"""Stands for the `ts1` of the newest TIMESYNC request before there is one."""

VEHICLE = np.dtype(
    [
        ("system_id", "i8"), ("wire_id", "i8"),
        ("copter", "?"),  # else a double integrator
        ("plain", "?"),  # whether kernels may run its common events: `sim_vehicles.vehicles.plain`
        ("pushed", "?"),  # whether kernels cannot move it: the craft moves itself before each event that they run
        ("version_1", "?"),  # whether it speaks MAVLink 1
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
        # FlightMode, or modes of a copter
        ("armed", "?"), ("flying", "?"), ("mode", "i8"), ("stopped", "i8"), ("deadline_ns", "i8"),
        ("guided_mode", "i8"), ("alarm_ns", "i8"),  # the next event that is neither a report nor a failsafe
        ("setpoint_ns", "i8"), ("setpoint_timeout_ns", "i8"), ("heartbeat_ns", "i8"), ("heartbeat_timeout_ns", "i8"),
        # the double integrator: its State at a time, its Command and its Bounds
        ("state_ns", "i8"), ("state", "f8", (4,)), ("command", "f8", (5,)), ("bounds", "f8", (4,)),
        ("altitude_m", "f8"),
        # a copter: its Motion at that time, its Target and its Limits; and what its set-points and reports depend on
        ("motion", "f8", (9,)), ("target", "f8", (12,)), ("limits", "f8", (7,)),
        ("velocity_gain_1_s", "f8"), ("growth", "f8"),
        ("autopilot", "i8"), ("ready_ns", "i8"), ("origin_neu_m", "f8", (3,)),
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
    vehicles["station"], vehicles["asked_ts1"], vehicles["autopilot"] = NOBODY, NEVER_ASKED, ARDUPILOT
    for name in ("acts_ns", "due_ns", "report_ns", "other_ns", "deadline_ns", "alarm_ns"):
        vehicles[name] = NEVER_NS
    return vehicles


def new_place() -> Place:
    """The place of a vehicle on its own."""
    vehicles = new_vehicles(1)
    return Place(vehicles, Columns(vehicles), 0)
