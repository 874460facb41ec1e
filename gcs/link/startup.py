"""The start-up of one vehicle: what it still lacks before it can be flown, and the message to send next.

`gcs.autopilot.startup` holds the start-up of vehicles with an autopilot.
"""

from math import inf
from typing import Any, Protocol

from gcs.link import mavlink
from gcs.link.kinds import ARM_DISARM, LAUNCHED, SET_MESSAGE_INTERVAL, Kind, Step, mode_command
from gcs.link.upload import Upload
from scenarios.schema import NS_PER_S

OPTIONAL = mavlink.POSITION_TARGET_LOCAL_NED
"""The message that a vehicle may refuse to send: prediction then assumes that every set-point acts."""
WITHOUT_TARGET = "does not report its active target"
"""The event text for a vehicle that refuses it."""

_STRANGER = "does not say that it is simulated"
_STRANGER_PATIENCE_NS, _ASK_AGAIN_NS = 10 * NS_PER_S, NS_PER_S // 2


def message_rates(rates_hz: dict[int, float]) -> dict[float, float]:
    """Message id to interval in µs, rounded as vehicles require, for SET_MESSAGE_INTERVAL; rates of 0 are left out."""
    return {float(message): float(round(1e6 / hz)) for message, hz in rates_hz.items() if hz}


class Startup(Protocol):
    """Base class of the part of the conversation that depends on the kind of vehicle."""

    kind: Kind
    refusal: str = ""
    """Why the vehicle must not be flown; empty if it may."""
    stays_disarmed: str = ""
    """Why the station must not arm it: it has landed, or somebody has disarmed it. Empty if it may."""
    stranger: bool = False
    """Whether the vehicle has yet to say that it is simulated; until then it is sent no commands."""
    arming_refusals: int = 0
    """Number of refusals to arm since it was last armed."""

    @property
    def is_halfway_up(self) -> bool:
        """Whether it has climbed to half of its take-off altitude or more."""
        return False

    def is_news(self, text: str) -> bool:  # noqa: ARG002 - most vehicles do not repeat themselves
        """Whether a text from the vehicle is new, not a repetition."""
        return True

    def recognise(self, autopilot: int, vehicle_type: int) -> Kind:
        """The kind of vehicle that its heartbeats have shown so far."""
        ...

    def take(self, msg_id: int, fields: tuple[Any, ...]) -> None:
        """Process a message from the vehicle; most do not concern the start-up."""

    def disarmed(self) -> None:
        """Note that somebody else has disarmed the vehicle; the station never does."""

    def next(self, *, custom_mode: int, armed: bool, clock_known: bool, now_ns: int) -> Step:
        """The next step towards taking set-points."""
        ...

    def next_parameter(self, now_ns: int, *, target_system: int, rtt_ns: int) -> tuple[int, tuple[Any, ...]] | None:
        """Message id and fields of the parameter message that is due, if any."""
        ...

    def accepted(self, command: int, parameters: tuple[float, ...], now_ns: int) -> None: ...
    def refused(self, command: int, parameters: tuple[float, ...], now_ns: int, *, repeated: bool) -> None: ...
    def begin_anew(self) -> None: ...  # the vehicle seems to have restarted


class LaunchedStartup(Startup):
    """Start-up of a double integrator: message rates, parameters of the loop on board if any, GUIDED, arming."""

    kind = LAUNCHED

    def __init__(
        self,
        telemetry_hz: float,
        parameters: dict[str, float] | None = None,
        *,
        target_hz: float = 0.0,
        stranger: bool = False,
    ) -> None:
        self.stranger = stranger
        self._rates = message_rates({mavlink.LOCAL_POSITION_NED: telemetry_hz, OPTIONAL: target_hz})
        self._set = set[float]()
        """The messages whose rates are settled."""
        self._upload = Upload(parameters or {})
        self._first_asked_ns, self._last_asked_ns = inf, -inf
        """When a stranger was asked for its scenario."""

    def recognise(self, autopilot: int, vehicle_type: int) -> Kind:  # noqa: ARG002 - the scenario gives the kind
        return LAUNCHED

    def take(self, msg_id: int, fields: tuple[Any, ...]) -> None:
        if msg_id == mavlink.PARAM_EXT_VALUE and mavlink.scenario_of(fields):
            self.stranger, self.refusal = False, self._upload.refusal
        if msg_id == mavlink.PARAM_VALUE and not self.stranger:
            self._upload.take(fields)
            self.refusal = self._upload.refusal

    def disarmed(self) -> None:
        """It may be armed again."""

    def next(self, *, custom_mode: int, armed: bool, clock_known: bool, now_ns: int) -> Step:  # noqa: ARG002
        if self.stranger:
            return Step(self.refusal or _STRANGER)
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
        if not self.stranger:
            return self._upload.next(now_ns, target_system=target_system, rtt_ns=rtt_ns)
        self._first_asked_ns = min(self._first_asked_ns, now_ns)
        if now_ns - self._first_asked_ns > max(_STRANGER_PATIENCE_NS, 5 * rtt_ns):
            self.refusal = f'{_STRANGER}, wanted dynamics = "autopilot" for a vehicle with an autopilot'
        if self.refusal or now_ns - self._last_asked_ns < _ASK_AGAIN_NS:
            return None
        self._last_asked_ns = now_ns
        return mavlink.PARAM_EXT_REQUEST_READ, mavlink.param_request_read(mavlink.SCENARIO, target_system=target_system)

    def accepted(self, command: int, parameters: tuple[float, ...], now_ns: int) -> None:  # noqa: ARG002
        if command == SET_MESSAGE_INTERVAL:
            self._set.add(parameters[0])

    def refused(self, command: int, parameters: tuple[float, ...], now_ns: int, *, repeated: bool) -> None:  # noqa: ARG002
        """Continue without the active target, which is optional; any other step is retried."""
        if command == SET_MESSAGE_INTERVAL and parameters[0] == OPTIONAL:
            self._set.add(parameters[0])

    def begin_anew(self) -> None:
        self._set.clear()
        self._upload.begin_anew()
