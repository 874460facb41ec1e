"""Answers of every kind of vehicle to requests for more than telemetry.

Most ground stations greet a vehicle by requesting AUTOPILOT_VERSION. From then on the vehicle also sends, at low rates,
the reports that such stations expect. Our own station does not greet, and gets only what it requests.
"""

import math
from collections import Counter
from dataclasses import dataclass

from sim_vehicles.services import frames, mavlink, messages
from sim_vehicles.services.mavlink import ACCEPTED, DENIED, UNSUPPORTED, Command, Encoder
from sim_vehicles.services.messages import EXTRA, Message, Request
from sim_vehicles.services.parameters import LIST_INTERVAL_US, Parameters
from sim_vehicles.services.schedule import US_PER_MS, Schedule

SHORTEST_INTERVAL_US = US_PER_MS
LONGEST_INTERVAL_US = 2**31
GREETED_US = {
    **dict.fromkeys(EXTRA, 1_000_000),
    frames.LOCAL_POSITION: 250_000,
    frames.GLOBAL_POSITION: 250_000,
    mavlink.HOME_POSITION: 2_000_000,
}
"""Intervals of the reports that start when a vehicle is greeted, unless they are already sent."""
STREAMS: dict[int, tuple[int, ...]] = {
    0: (*EXTRA, frames.LOCAL_POSITION, frames.GLOBAL_POSITION),
    2: (messages.SYS_STATUS, messages.GPS_RAW),
    6: (frames.LOCAL_POSITION, frames.GLOBAL_POSITION),
    10: (messages.ATTITUDE,),
    11: (messages.VFR_HUD,),
    12: (messages.BATTERY_STATUS, messages.EKF_STATUS),
}
"""MAV_DATA_STREAM: the messages of each group, as ArduPilot groups them."""

SCENARIO = "SCENARIO"
"""Extended parameter with the experiment that a simulated vehicle belongs to, as text: the fingerprint of its scenario
(links and seed included) and the scenario's name. Sent on request only, so other stations never see it."""
LONGEST_TEXT = 128
KEEP, SHUT_DOWN = 0.0, 2.0
"""MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, parameter 1: do nothing, shut down."""


@dataclass(slots=True)
class Services:
    """The parameters and message rates of one vehicle, and its answers about them."""

    encoder: Encoder
    schedule: Schedule
    parameters: Parameters
    version: tuple[int, int, int]
    defaults_us: dict[int, int]
    """The messages that can be requested, each with its default interval, 0 for none."""
    reports_from_ns: int
    """No report is sent before this time."""
    experiment: str
    """Text of the parameter SCENARIO."""
    orphaned: bool = False
    """Whether the station that started the simulation has gone, so that another one may end it."""
    shut_down_ns: int | None = None
    """When an orphaned vehicle was told to shut down; None if it was not."""

    def answer(self, request: Request, counters: Counter[str], time_ns: int) -> list[bytes]:
        if isinstance(request, messages.Mission):
            return [self.encoder.pack(messages.mission_answer(request))]
        if isinstance(request, messages.FileTransfer):
            return [self.encoder.pack(messages.file_answer(request))]
        if isinstance(request, messages.TextRead):
            known = request.param_id == SCENARIO
            return [self.encoder.pack(messages.text_value(SCENARIO, self.experiment))] if known else []
        if isinstance(request, messages.DataStream):
            rate_hz = request.req_message_rate if request.start_stop else 0
            interval_us = max(SHORTEST_INTERVAL_US, round(1e6 / rate_hz)) if rate_hz else 0
            for message_id in STREAMS.get(request.req_stream_id, ()):
                if message_id in self.defaults_us:
                    self._set(message_id, interval_us, time_ns)
            return []
        assert not isinstance(request, messages.SetMode)
        answers = self.parameters.answer(request, self.encoder, counters)
        if self.parameters.listing:
            self._set(frames.PARAMETER_VALUE, LIST_INTERVAL_US, time_ns)
        return answers

    def next_parameter(self, time_ns: int) -> bytes:
        """The frame of the next parameter of a list, which is due now."""
        frame = self.parameters.next_of_list(self.encoder)
        if not self.parameters.listing:
            self._set(frames.PARAMETER_VALUE, 0, time_ns)
        return frame

    def command(self, command: Command, time_ns: int) -> tuple[int, list[Message]]:
        """Obey a command about messages. Returns its MAV_RESULT and what to send at once; reports are scheduled."""
        number, message_id, second = command.command, whole(command.param1), whole(command.param2)
        wants_message = number == mavlink.COMMAND_REQUEST
        if number == mavlink.COMMAND_INTERVAL:
            answer = self._set_interval(message_id, second, time_ns), []
        elif number == mavlink.COMMAND_GET_INTERVAL:
            answer = self._interval(message_id)
        elif wants_message and message_id == mavlink.MESSAGE_INTERVAL:
            answer = self._interval(second)
        elif number == mavlink.COMMAND_CAPABILITIES or (wants_message and message_id == mavlink.AUTOPILOT_VERSION):
            answer = self._greet(time_ns)
        elif number == mavlink.COMMAND_GET_HOME:
            answer = self._request(mavlink.HOME_POSITION, time_ns), []
        elif wants_message:
            answer = self._request(message_id, time_ns), []
        elif number == mavlink.COMMAND_SHUTDOWN and command.param1 in (KEEP, SHUT_DOWN):
            answer = ACCEPTED if command.param1 == KEEP else self._shut_down(time_ns), []
        else:
            answer = UNSUPPORTED, []
        return answer

    def _set_interval(self, message_id: int | None, interval_us: int | None, time_ns: int) -> int:
        if message_id not in self.defaults_us or interval_us is None:
            return DENIED
        if interval_us == 0:
            interval_us = self.defaults_us[message_id]
        elif interval_us == -1:
            interval_us = 0
        elif not SHORTEST_INTERVAL_US <= interval_us < LONGEST_INTERVAL_US:
            return DENIED
        self._set(message_id, interval_us, time_ns)
        return ACCEPTED

    def _request(self, message_id: int | None, time_ns: int) -> int:
        if message_id not in self.defaults_us or time_ns < self.reports_from_ns:
            return DENIED
        self.schedule.add_once(message_id, time_ns)
        return ACCEPTED

    def _shut_down(self, time_ns: int) -> int:
        if not self.orphaned:
            return DENIED
        self.shut_down_ns = self.shut_down_ns or time_ns
        return ACCEPTED

    def _greet(self, time_ns: int) -> tuple[int, list[Message]]:
        """Answer with AUTOPILOT_VERSION, and start the reports that a station asking for it expects."""
        for message_id, interval_us in GREETED_US.items():
            if not self.schedule.interval_us(message_id):
                self._set(message_id, interval_us, time_ns)
        bytewise = self.parameters.bytewise
        uid = self.encoder.wire_id
        return ACCEPTED, [messages.autopilot_version(self.version, uid, parameters_bytewise=bytewise)]

    def _interval(self, message_id: int | None) -> tuple[int, list[Message]]:
        if message_id not in self.defaults_us:
            return DENIED, []
        interval_us = self.schedule.interval_us(message_id) or -1
        return ACCEPTED, [messages.message_interval(message_id, interval_us)]

    def _set(self, message_id: int, interval_us: int, time_ns: int) -> None:
        if message_id != frames.HEARTBEAT:
            time_ns = max(time_ns, self.reports_from_ns)
        self.schedule.set_interval(message_id, interval_us, time_ns)


def whole(parameter: float) -> int | None:
    """A command's parameter as a whole number, or None if it is not one."""
    return int(parameter) if math.isfinite(parameter) and parameter == int(parameter) else None
