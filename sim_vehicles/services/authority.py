"""Whose commands a vehicle obeys: those of one ground station at a time."""

from collections import Counter

from scenarios.schema import NS_PER_S
from sim_vehicles.services.mavlink import (
    COMMAND_CAPABILITIES,
    COMMAND_GET_HOME,
    COMMAND_GET_INTERVAL,
    COMMAND_INTERVAL,
    COMMAND_REQUEST,
    Command,
    Message,
    Setpoint,
)
from sim_vehicles.services.service_messages import DataStream, ParameterSet, SetMode

_QUESTIONS = frozenset((COMMAND_CAPABILITIES, COMMAND_GET_HOME, COMMAND_GET_INTERVAL, COMMAND_REQUEST))


class Authority:
    """Remembers the system that commands a vehicle: the first to do so, until it has been silent for a time.

    Who only asks, listens or sends heartbeats does not become the station, and is not kept from it. A rate of reports
    is set by the station, or by anybody while there is none, who does not become it: display programs do so at once.
    """

    def __init__(self, silence_s: float) -> None:
        self.station: int | None = None
        self._silence_ns = round(silence_s * NS_PER_S)
        self.commanded_ns = 0
        """When that system last commanded it: to ask, to listen and to send heartbeats is not to command."""
        self._heard_ns = 0
        self._refused: set[int] = set()

    def obeys(self, source: int, message: Message, time_ns: int) -> bool:
        """Whether a message to this vehicle may be acted upon; if it wants something, its sender is the station."""
        if not isinstance(message, Setpoint | Command | ParameterSet | SetMode | DataStream):
            return True
        command = message.command if isinstance(message, Command) else None
        if command in _QUESTIONS:
            return True
        if not self.hears(source, time_ns):
            return False
        if command == COMMAND_INTERVAL or isinstance(message, DataStream):
            return True
        self.station, self._heard_ns, self.commanded_ns = source, time_ns, time_ns
        return True

    def hears(self, source: int, time_ns: int) -> bool:
        """Whether a heartbeat of a ground station counts: it is that of the station, or there is none."""
        if source == self.station:
            self._heard_ns = time_ns
            return True
        return self.station is None or time_ns - self._heard_ns > self._silence_ns

    def refusal(self, source: int, counters: Counter[str]) -> str:
        """What is said of a system that is refused, once; then an empty string."""
        counters["refused_not_the_station"] += 1
        if source in self._refused:
            return ""
        self._refused.add(source)
        return f"refused: system {source}, obeys system {self.station}"
