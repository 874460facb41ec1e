"""Takes over vehicles that are already sending to the station before its flight, if they fly the same experiment.

Simulated vehicles whose station was killed fly on for a while. Only a flight with the same scenario, links and seed may
take them over: otherwise its verdict would be about another experiment. Each vehicle names its scenario in the extended
parameter SCENARIO, which other ground stations do not request.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial

from gcs.control.phases import longest_round_trip_s
from gcs.drive.udp import StationSocket, clock_ns
from gcs.errors import InputError
from gcs.link import mavlink
from gcs.link.datagram import Address, Outgoing, network_at
from gcs.station.reception import AUTOPILOT_COMPONENT
from scenarios.files import fingerprint
from scenarios.networks import wire_id
from scenarios.schema import NS_PER_S, Scenario

TAKEN_OVER = "taken over: they were there already"
CONNECTED = "not started here (--connect)"
_SHUTDOWN, _KEEP, _SHUT_DOWN = 246, 0.0, 2.0
"""MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN and two values of its first parameter: do nothing, and shut down. Even the first
restarts the minute for which vehicles fly on without a station."""
_HEARTBEAT_PERIOD_S = 1.2
"""Time within which vehicles already in flight are heard."""
_ASK_AGAIN_NS = NS_PER_S // 4
_LEAST_PATIENCE_S = 3.0
_ROUND_TRIPS = 4.0
"""Timeout for answers, in round trips of the links; at least `_LEAST_PATIENCE_S`."""


class Presence:
    """The vehicles of a scenario that are already sending to the station's socket before its flight."""

    def __init__(self, link: StationSocket, scenario: Scenario) -> None:
        self._link = link
        self._scenario = scenario
        self._wanted = {vehicle.system_id for vehicle in scenario.vehicles}
        self._addresses: dict[int, Address] = {}
        self._sequence = 0

    def taken_over(self) -> list[int]:
        """Take over the vehicles that are present; returns their system ids, empty if there are none.

        Raises InputError if they fly another scenario, do not say which, or do not obey.
        """
        self._listen(self._link.bound_ns + round(_HEARTBEAT_PERIOD_S * NS_PER_S))

        def scenario(frame: mavlink.Frame) -> str:
            return mavlink.scenario_of(frame.fields) if frame.msg_id == mavlink.PARAM_EXT_VALUE else ""

        there, fields = sorted(self._addresses), partial(mavlink.param_request_read, mavlink.SCENARIO)
        said = self._ask(there, mavlink.PARAM_EXT_REQUEST_READ, fields, scenario)
        for system_id in there:
            if (text := said.get(system_id, "")).split(" ")[0] != fingerprint(self._scenario):
                raise InputError(self._refusal(there, self._flown(text)))
        if self._command(there, _KEEP) != there:
            raise InputError(self._refusal(there, "do not obey"))
        return there

    def shut_down(self) -> None:
        """Shut down the vehicles taken over. A vehicle whose own station is alive does not obey."""
        self._command(sorted(self._addresses), _SHUT_DOWN)

    def _command(self, system_ids: list[int], wanted: float) -> list[int]:
        """The vehicles that acknowledged the command."""

        def acknowledgement(frame: mavlink.Frame) -> str:
            return "done" if frame.msg_id == mavlink.COMMAND_ACK and frame.fields[0] == _SHUTDOWN else ""

        fields = partial(mavlink.command_long, _SHUTDOWN, parameters=(wanted,))
        return sorted(self._ask(system_ids, mavlink.COMMAND_LONG, fields, acknowledgement))

    def _ask(
        self,
        system_ids: Iterable[int],
        msg_id: int,
        fields: Callable[..., tuple[object, ...]],
        answer: Callable[[mavlink.Frame], str],
    ) -> dict[int, str]:
        """Each vehicle's answer to a message, which is resent until the answer arrives or the timeout expires.

        `fields` makes the fields of the message for a `target_system`; `answer` extracts the text from a frame, "" if
        the frame is no answer.
        """
        said: dict[int, str] = {}
        left = set(system_ids)
        patience_s = max(_LEAST_PATIENCE_S, _ROUND_TRIPS * longest_round_trip_s(self._scenario))
        end_ns = clock_ns() + round(patience_s * NS_PER_S)
        while left and (now_ns := clock_ns()) < end_ns:
            outgoing: list[Outgoing] = []
            for system_id in sorted(left):
                self._sequence += 1
                frame = mavlink.encode(msg_id, fields(target_system=wire_id(system_id)), sequence=self._sequence)
                outgoing.append((frame, self._addresses[system_id]))
            self._link.send(outgoing)
            for frame in self._listen(now_ns + _ASK_AGAIN_NS):
                if frame.system_id in left and (text := answer(frame)):
                    said[frame.system_id] = text
                    left.discard(frame.system_id)
        return said

    def _listen(self, until_ns: int) -> list[mavlink.Frame]:
        """The frames received until a time from vehicles of the scenario; notes the vehicles' addresses."""
        frames: list[mavlink.Frame] = []
        now_ns = 0
        while now_ns < until_ns:
            self._link.wait(until_ns)
            now_ns = clock_ns()  # read before the socket: all that arrived by the deadline is then received
            for datagram in self._link.receive():
                frames_in = mavlink.decode_either(datagram.data, Counter())
                for frame in mavlink.in_network(frames_in, network_at(datagram.address)):
                    if frame.system_id in self._wanted and frame.component_id == AUTOPILOT_COMPONENT:
                        self._addresses[frame.system_id] = datagram.address
                        frames.append(frame)
        return frames

    def _flown(self, text: str) -> str:
        """A phrase for what the vehicles that gave this answer are flying."""
        _, _, name = text.partition(" ")
        if not name:
            return "do not say which scenario they fly"
        same = name == self._scenario.name
        return f"fly {name} with other links, another seed or other settings" if same else f"fly {name}"

    def _refusal(self, there: list[int], flown: str) -> str:
        """The error as one line: who is present, what they fly, and what the user can do."""
        host, port = self._link.address
        who = f"vehicle{'s' * (len(there) > 1)} {' '.join(map(str, there))}"
        return (
            f"{who} at {host}:{port} {flown}, wanted vehicles of this same scenario or none: wait (those of a killed "
            f"station end within a minute), use --listen with another port, or fly them with --connect {host}:{port}"
        )
