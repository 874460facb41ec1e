"""Parameters that make a vehicle look set up to ground stations. They have no effect.

Without them QGroundControl warns: it looks for a frame, calibrated sensors, a mapped radio and a battery.
"""

from sim_vehicles.services.parameters import Parameter

_ARDUPILOT_VALUES: dict[str, float] = {
    "ARMING_CHECK": 1,
    "FRAME_CLASS": 1,
    "FRAME_TYPE": 1,
    "BATT_MONITOR": 4,
    "BATT_CAPACITY": 3300,
    **{f"COMPASS_DEV_ID{number}": 0 for number in ("", "2", "3")},
    **{f"COMPASS_USE{number}": 0 for number in ("", "2", "3")},
    **{f"COMPASS_OFS{number}_{axis}": 0.0 for number in ("", "2", "3") for axis in "XYZ"},
    **{f"INS_ACCOFFS_{axis}": 0.01 for axis in "XYZ"},
    **{f"RCMAP_{stick}": channel for channel, stick in enumerate(("ROLL", "PITCH", "THROTTLE", "YAW"), 1)},
    **{
        f"RC{channel}_{end}": pulse
        for channel in (1, 2, 3, 4)
        for end, pulse in (("MIN", 1000), ("TRIM", 1500), ("MAX", 2000))
    },
}
_PX4_VALUES: dict[str, float] = {
    "SYS_AUTOSTART": 4001,
    "SYS_HAS_MAG": 1,
    "CAL_ACC0_ID": 1,
    "CAL_GYRO0_ID": 1,
    "CAL_MAG0_ID": 1,
    "BAT1_N_CELLS": 3,
    "BAT1_V_CHARGED": 4.05,
    "BAT1_V_EMPTY": 3.5,
    "COM_RC_IN_MODE": 1,
    **{f"RC_MAP_{stick}": channel for channel, stick in enumerate(("ROLL", "PITCH", "THROTTLE", "YAW"), 1)},
}
ARDUPILOT, PX4 = (
    [Parameter(name, value, whole=isinstance(value, int)) for name, value in values.items()]
    for values in (_ARDUPILOT_VALUES, _PX4_VALUES)
)
