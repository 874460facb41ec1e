"""Command authority: a vehicle obeys one ground station at a time."""

from collections import Counter

from scenarios.kernel import Cell
from scenarios.schema import NS_PER_S
from sim_vehicles.services import mavlink
from sim_vehicles.services.hot import NOBODY, Place
from sim_vehicles.services.mavlink import Command, Read, Setpoint
from sim_vehicles.services.messages import DataStream, ParameterSet, SetMode

_QUESTIONS = frozenset(
    (mavlink.COMMAND_CAPABILITIES, mavlink.COMMAND_GET_HOME, mavlink.COMMAND_GET_INTERVAL, mavlink.COMMAND_REQUEST)
)


class Authority:
    """Remembers a vehicle's station: the first system that commands it, until that system has been silent for too long.

    A system that only asks, listens or sends heartbeats does not become the station, and is always answered. While
    there is no station, any system may set report rates without becoming it: display programs set rates as soon as they
    start.
    """

    station = Cell[int | None](NOBODY)
    commanded_ns = Cell[int]()
    """When the station last commanded the vehicle; questions and heartbeats do not count."""
    _heard_ns = Cell[int]()

    def __init__(self, place: Place, silence_s: float) -> None:
        _, self._columns, self._row = place
        self._silence_ns = round(silence_s * NS_PER_S)
        self._refused: set[int] = set()

    def obeys(self, source: int, message: Read, time_ns: int) -> bool:
        """Whether to act on a message to this vehicle; a command makes its sender the station."""
        if not isinstance(message, Setpoint | Command | ParameterSet | SetMode | DataStream):
            return True
        command = message.command if isinstance(message, Command) else None
        if command in _QUESTIONS:
            return True
        if not self.hears(source, time_ns):
            return False
        if command == mavlink.COMMAND_INTERVAL or isinstance(message, DataStream):
            return True
        self.station, self._heard_ns, self.commanded_ns = source, time_ns, time_ns
        return True

    def hears(self, source: int, time_ns: int) -> bool:
        """Whether a ground station's heartbeat counts: it comes from the station, or there is no station."""
        if source == self.station:
            self._heard_ns = time_ns
            return True
        return self.station is None or time_ns - self._heard_ns > self._silence_ns

    def refusal(self, source: int, counters: Counter[str]) -> str:
        """Count a refusal. Returns the text that reports it, or "" if this system was refused before."""
        counters["refused_not_the_station"] += 1
        if source in self._refused:
            return ""
        self._refused.add(source)
        return f"refused: system {source}, obeys system {self.station}"
