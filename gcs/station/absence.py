"""Vehicles that the formation cannot count on: those not heard, and those that are taken over."""

from collections.abc import Sequence

from gcs.link.vehicle import RemoteVehicle

LOST, TAKEN_OVER = "is lost", "is taken over, by its pilot or by itself"
COMPLETED = "completed: duration reached"


def absences(vehicles: Sequence[RemoteVehicle], silent: Sequence[bool]) -> list[str]:
    """Why each vehicle is flown around, "" if it is not."""
    return [
        LOST if gone else TAKEN_OVER if vehicle.taken_over else ""
        for vehicle, gone in zip(vehicles, silent, strict=True)
    ]


def told(was: str, now: str) -> str:
    """What is said when that changes."""
    return now or ("is heard again" if was == LOST else "is given back")


def end_reason(vehicles: Sequence[RemoteVehicle], absent: Sequence[str]) -> str:
    """Why the flight ends when its time has come, or when nobody is left."""
    if all(reason == LOST for reason in absent):
        return "lost: all vehicles"
    kinds = (("lost", LOST), ("taken over", TAKEN_OVER))
    gone = {
        word: ", ".join(str(v.system_id) for v, reason in zip(vehicles, absent, strict=True) if reason == kind)
        for word, kind in kinds
    }
    return "; ".join(f"{word}: vehicles {which}" for word, which in gone.items() if which) or COMPLETED
