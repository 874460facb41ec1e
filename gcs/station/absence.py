"""Which vehicles are absent from the formation: those that are lost, and those that a pilot or autopilot flies."""

from collections.abc import Sequence

from gcs.link.vehicle import RemoteVehicle

LOST, TAKEN_OVER = "is lost", "is taken over by its pilot or its autopilot"
COMPLETED = "completed: duration reached"


def absences(vehicles: Sequence[RemoteVehicle], silent: Sequence[bool]) -> list[str]:
    """Why each vehicle is absent; "" for one that takes part."""
    return [
        LOST if gone else TAKEN_OVER if vehicle.taken_over else ""
        for vehicle, gone in zip(vehicles, silent, strict=True)
    ]


def describe_change(was: str, now: str) -> str:
    """The text of the event when a vehicle's absence changes."""
    return now or ("is heard again" if was == LOST else "is given back")


def end_reason(vehicles: Sequence[RemoteVehicle], absent: Sequence[str]) -> str:
    """Why a flight ends: its duration has passed, or no vehicle is left. Absent vehicles are named."""
    if all(reason == LOST for reason in absent):
        return "lost: all vehicles"
    kinds = (("lost", LOST), ("taken over", TAKEN_OVER))
    gone = {
        word: ", ".join(str(v.system_id) for v, reason in zip(vehicles, absent, strict=True) if reason == kind)
        for word, kind in kinds
    }
    return "; ".join(f"{word}: vehicles {which}" for word, which in gone.items() if which) or COMPLETED
