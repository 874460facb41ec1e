"""The journal of a flight: its events, and the reason why it is to end. All parts of a station write to it."""

from gcs.control.tick import Event
from scenarios.schema import NS_PER_S


class Journal:
    """Records events as they happen. Times are on the station's clock; `now_ns` is the time of the current step.

    It holds no reference to the parts that write to it, so a station that is no longer used is freed at once and not by
    the next garbage collection of reference cycles.
    """

    def __init__(self, start_ns: int, patience_s: float) -> None:
        self.now_ns = start_ns
        self.events: list[Event] = []
        self.stop = ""
        """Why the flight is to end; the first reason is kept."""
        self.flight_start_ns: int | None = None
        """When the formation flight began."""
        self._start_ns, self._patience_s = start_ns, patience_s

    @property
    def zero(self) -> tuple[int, float]:
        """The instant from which `scenario_time_s` counts, and the time that it subtracts."""
        return (self._start_ns, self._patience_s) if self.flight_start_ns is None else (self.flight_start_ns, 0.0)

    def scenario_time_s(self, now_ns: int) -> float:
        """Time since the flight began; before that, time since the start minus the patience: negative."""
        zero_ns, before_s = self.zero
        return (now_ns - zero_ns) / NS_PER_S - before_s

    def request_stop(self, reason: str) -> None:
        """End the flight at the next tick; an empty reason is ignored."""
        self.stop = self.stop or reason

    def report(self, kind: str, text: str, system_id: int | None = None, counts: dict[str, int] | None = None) -> None:
        """Record an event."""
        time_s = self.scenario_time_s(self.now_ns)
        self.events.append(Event(time_s=time_s, kind=kind, text=text, system_id=system_id, counts=counts))
