"""Absent vehicles: lost, left out, landed, disarmed, or flown by a pilot or by the autopilot on its own account."""

from collections.abc import Sequence
from math import nan

from gcs.autopilot.kinds import HAS_LANDED, WAS_DISARMED
from gcs.link.vehicle import RemoteVehicle
from scenarios.kernel import Records

LOST, TAKEN_OVER = "is lost", "is taken over by its pilot or its autopilot"
LEFT_OUT = "is left out: it did not become ready"
COMPLETED = "completed: duration reached"


def absence(vehicle: RemoteVehicle, *, gone: bool) -> str:
    """Why a vehicle is absent; "" if it takes part. `gone`: its telemetry has timed out."""
    if vehicle.left_out:
        return LEFT_OUT
    if gone:
        return LOST
    return vehicle.startup.stays_disarmed or (TAKEN_OVER if vehicle.taken_over else "")


GROUNDED = (HAS_LANDED, WAS_DISARMED)
"""Why a vehicle on the ground is absent; others may fly over it."""
PILOTED = (TAKEN_OVER, *GROUNDED)
"""Why a vehicle is absent if its pilot flies it, or has landed or disarmed it."""


def off_the_ground(controls: Records, absent: Sequence[str]) -> Records:
    """The controls without the states of vehicles on the ground: they are not near those that fly over them."""
    if not any(absent):
        return controls
    kept = controls.copy()
    kept["state"][[why in GROUNDED for why in absent]] = nan
    return kept


def describe_change(was: str, now: str) -> str:
    """The event text for a change in a vehicle's absence."""
    return now or ("is heard again" if was == LOST else "is given back")


def end_reason(vehicles: Sequence[RemoteVehicle], absent: Sequence[str]) -> str:
    """Why a flight ends: its duration has passed, or no vehicle is left. It names absent vehicles."""
    if all(reason == LOST for reason in absent):
        return "lost: all vehicles"
    kinds = (
        ("left out", LEFT_OUT), ("lost", LOST), ("taken over", TAKEN_OVER), ("landed", HAS_LANDED),
        ("disarmed", WAS_DISARMED),
    )  # fmt: skip
    gone = {
        word: ", ".join(str(v.system_id) for v, reason in zip(vehicles, absent, strict=True) if reason == kind)
        for word, kind in kinds
    }
    return "; ".join(f"{word}: vehicles {which}" for word, which in gone.items() if which) or COMPLETED
