"""The kinds of vehicle, as data: modes and traits on which the conversation with a vehicle depends."""

from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

SET_MODE = 176
ARM_DISARM = 400
TAKE_OFF = 22
SET_MESSAGE_INTERVAL = 511
CUSTOM_MODE_ENABLED = 1.0

Command = tuple[int, tuple[float, ...]]
"""Number and parameters of a COMMAND_LONG."""


class Goal(Enum):
    """The state to which the station brings a vehicle."""

    FLY = "take set-points"
    END = "hold or land by itself"


@dataclass(frozen=True)
class Kind:
    """One kind of vehicle. Modes are values of HEARTBEAT.custom_mode."""

    name: str
    guided_mode: int
    """The mode in which it takes set-points."""
    hold_mode: int
    """The mode in which it holds its position without a pilot."""
    land_mode: int
    take_off_mode: int = -1
    """The mode in which it takes off and then holds; -1 if that is the guided mode."""
    guided_name: str = "GUIDED"
    estimator_message: int = 0
    """The message that reports whether the vehicle knows its position."""
    piloted: bool = True
    """A pilot, or the autopilot itself, may take it out of the guided mode."""
    guided_first: bool = True
    """It becomes guided on the ground, before it is armed; otherwise only in the air, while set-points arrive."""
    altitude_above_sea: bool = False
    """Its take-off command takes an altitude above sea level, not above home."""
    failsafe_mode: int = -1
    """The mode that it enters by itself, reporting a failsafe, when set-points stop; -1 if it stays guided. Any other
    mode is the choice of its pilot, or of its autopilot on its own account."""
    velocity_grows: bool = False
    """Between set-points its velocity target grows with the acceleration."""
    timesync_error_ns: int = 0
    """The largest usual error of the stamps in its TIMESYNC replies."""
    packed_modes: bool = False
    """A mode has a main and a sub number: two parameters in DO_SET_MODE, packed into one number in HEARTBEAT."""


LAUNCHED = Kind("launched UAV", guided_mode=4, hold_mode=5, land_mode=5, piloted=False)
"""The simulated double integrators."""
UNRECOGNISED = replace(LAUNCHED, name="unrecognised vehicle", piloted=True)
"""A vehicle with an autopilot whose heartbeat has not yet shown which one it is."""


def packed(main: int, sub: int = 0) -> int:
    """The HEARTBEAT.custom_mode of a main and a sub mode."""
    return main << 16 | sub << 24


def mode_command(kind: Kind, custom_mode: int) -> Command:
    """The DO_SET_MODE command that selects a custom mode."""
    if not kind.packed_modes:
        return SET_MODE, (CUSTOM_MODE_ENABLED, float(custom_mode))
    return SET_MODE, (CUSTOM_MODE_ENABLED, float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24))


def commanded_mode(kind: Kind, parameters: tuple[float, ...]) -> int:
    """The custom mode that a DO_SET_MODE with these parameters asks for."""
    return packed(int(parameters[1]), int(parameters[2])) if kind.packed_modes else int(parameters[1])


class Step(NamedTuple):
    """What a vehicle still lacks ("" if nothing), and the command that may provide it (None: wait)."""

    missing: str
    command: Command | None = None
