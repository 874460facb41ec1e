"""The start-up of one vehicle: what it lacks until it can be flown, and the message to send next.

`gcs.autopilot.startup` has that of vehicles with an autopilot.
"""

from typing import Any, Protocol

from gcs.link import mavlink
from gcs.link.kinds import ARM_DISARM, LAUNCHED, SET_MESSAGE_INTERVAL, Kind, Step, mode_command
from gcs.link.upload import Upload

OPTIONAL = mavlink.POSITION_TARGET_LOCAL_NED
"""The message without which a vehicle can be flown: prediction then assumes that every set-point acts."""
WITHOUT_TARGET = "does not report its active target"
"""The event of a vehicle that refuses this message."""


def message_rates(rates_hz: dict[int, float]) -> dict[float, float]:
    """The interval in µs of each message that is sent, as parameters of a command; vehicles take whole numbers."""
    return {float(message): float(round(1e6 / hz)) for message, hz in rates_hz.items() if hz}


class Startup(Protocol):
    """The part of the conversation with a vehicle that depends on its kind; each kind inherits this."""

    kind: Kind
    refusal: str = ""
    """Why the vehicle must not be flown; empty if it may."""
    stays_disarmed: str = ""
    """Why the station must not arm it: it has landed, or somebody has disarmed it. Empty if it may."""
    arming_refusals: int = 0
    """How often it has refused to arm since it was armed last."""

    @property
    def is_half_way_up(self) -> bool:
        """Whether it has climbed to half of its take-off altitude or more."""
        return False

    def is_news(self, text: str) -> bool:  # noqa: ARG002 - most vehicles seldom speak
        """Whether a text from the vehicle is new, not one that it only repeats."""
        return True

    def recognise(self, autopilot: int, vehicle_type: int) -> Kind:
        """The kind of vehicle, as far as its heartbeats show it."""
        ...

    def take(self, msg_id: int, fields: tuple[Any, ...]) -> None:
        """Take in a message from the vehicle; only some concern the start-up."""

    def next(self, *, custom_mode: int, armed: bool, clock_known: bool, now_ns: int) -> Step:
        """The next step towards a vehicle that takes set-points."""
        ...

    def next_parameter(self, now_ns: int, *, target_system: int, rtt_ns: int) -> tuple[int, tuple[Any, ...]] | None:
        """Message id and fields of the parameter message that is due, if one is."""
        ...

    def accepted(self, command: int, parameters: tuple[float, ...], now_ns: int) -> None: ...
    def refused(self, command: int, parameters: tuple[float, ...], now_ns: int, *, repeated: bool) -> None: ...
    def disarmed(self) -> None: ...  # by somebody else, as the station never does it
    def begin_anew(self) -> None: ...  # the vehicle seems to have restarted


class LaunchedStartup(Startup):
    """Start-up of a double integrator: telemetry rate, parameters of the loop on board if any, GUIDED, armed."""

    kind = LAUNCHED

    def __init__(
        self, telemetry_hz: float, parameters: dict[str, float] | None = None, *, target_hz: float = 0.0
    ) -> None:
        self._rates = message_rates({mavlink.LOCAL_POSITION_NED: telemetry_hz, OPTIONAL: target_hz})
        self._set = set[float]()
        """The messages whose rates are settled."""
        self._upload = Upload(parameters or {})

    def recognise(self, autopilot: int, vehicle_type: int) -> Kind:  # noqa: ARG002 - it is what the scenario says
        return LAUNCHED

    def take(self, msg_id: int, fields: tuple[Any, ...]) -> None:
        if msg_id == mavlink.PARAM_VALUE:
            self._upload.take(fields)
            self.refusal = self._upload.refusal

    def next(self, *, custom_mode: int, armed: bool, clock_known: bool, now_ns: int) -> Step:  # noqa: ARG002
        guided, uploaded = custom_mode == LAUNCHED.guided_mode, self._upload.done
        due = next(((m, us) for m, us in self._rates.items() if m not in self._set), None)
        command = None
        if due is not None:
            command = SET_MESSAGE_INTERVAL, due
        elif not guided:
            command = mode_command(LAUNCHED, LAUNCHED.guided_mode)
        elif uploaded and not armed:
            command = ARM_DISARM, (1.0,)
        lacks = (
            ("does not accept the telemetry rate", due is not None),
            ("does not answer TIMESYNC", not clock_known),
            (self._upload.missing, not uploaded),
            ("does not enter GUIDED", not guided),
            ("does not arm", not armed),
        )
        return Step(self.refusal or next((text for text, lacking in lacks if lacking), ""), command)

    def next_parameter(self, now_ns: int, *, target_system: int, rtt_ns: int) -> tuple[int, tuple[Any, ...]] | None:
        return self._upload.next(now_ns, target_system=target_system, rtt_ns=rtt_ns)

    def accepted(self, command: int, parameters: tuple[float, ...], now_ns: int) -> None:  # noqa: ARG002
        if command == SET_MESSAGE_INTERVAL:
            self._set.add(parameters[0])

    def refused(self, command: int, parameters: tuple[float, ...], now_ns: int, *, repeated: bool) -> None:  # noqa: ARG002
        """Go on without the active target, which is optional; any other step is tried again."""
        if command == SET_MESSAGE_INTERVAL and parameters[0] == OPTIONAL:
            self._set.add(parameters[0])

    def begin_anew(self) -> None:
        self._set.clear()
        self._upload.begin_anew()
