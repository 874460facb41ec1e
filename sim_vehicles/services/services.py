"""What every kind of vehicle answers when a ground station asks for more than telemetry.

Most ground stations greet a vehicle with a request for AUTOPILOT_VERSION. From then on it also sends, slowly, the
reports that they expect. Our own station does not greet, and is sent only what it requests.
"""

import math
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

from sim_vehicles.services import mavlink, service_messages
from sim_vehicles.services.earth import ORIGIN_ALTITUDE_M
from sim_vehicles.services.mavlink import ACCEPTED, DENIED, UNSUPPORTED, Command, Encoder
from sim_vehicles.services.parameters import LIST_INTERVAL_US, Parameters
from sim_vehicles.services.schedule import US_PER_MS, Schedule
from sim_vehicles.services.service_messages import (
    ATTITUDE,
    BATTERY_STATUS,
    EXTENDED_SYS_STATE,
    GPS_RAW,
    IN_AIR,
    ON_GROUND,
    PARAMETER_VALUE,
    SYS_STATUS,
    VFR_HUD,
    DataStream,
    FileTransfer,
    Mission,
    Request,
    TextRead,
)

SHORTEST_INTERVAL_US = US_PER_MS
LONGEST_INTERVAL_US = 2**31
EXTRA = (SYS_STATUS, EXTENDED_SYS_STATE, GPS_RAW, ATTITUDE, BATTERY_STATUS, VFR_HUD)
"""The messages that every vehicle can send besides its telemetry."""
GREETED_US = {
    **dict.fromkeys(EXTRA, 1_000_000),
    mavlink.LOCAL_POSITION: 250_000,
    mavlink.GLOBAL_POSITION: 250_000,
    mavlink.HOME_POSITION: 2_000_000,
}
"""Intervals of the reports that start when a vehicle is greeted, unless they are already sent."""
STREAMS: dict[int, tuple[int, ...]] = {
    0: (*EXTRA, mavlink.LOCAL_POSITION, mavlink.GLOBAL_POSITION),
    2: (SYS_STATUS, GPS_RAW),
    6: (mavlink.LOCAL_POSITION, mavlink.GLOBAL_POSITION),
    10: (ATTITUDE,),
    11: (VFR_HUD,),
    12: (BATTERY_STATUS, mavlink.EKF_STATUS),
}
"""MAV_DATA_STREAM: the messages of each group, as ArduPilot groups them."""

SCENARIO = "SCENARIO"
"""The extended parameter that says, as text, which experiment a simulated vehicle belongs to: the fingerprint of its
scenario, links and seed included, and the scenario's name. It is sent only on request, so stations that do not know it
never see it."""
LONGEST_TEXT = 128
KEEP, SHUT_DOWN = 0.0, 2.0
"""MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, parameter 1: do nothing, shut down."""

FTP_TERMINATE, FTP_RESET, FTP_ACK, FTP_NAK = 1, 2, 128, 129
FTP_OPENS = (3, 4, 14)
"""List a directory, open a file to read, compute its checksum."""
FTP_FILE_NOT_FOUND, FTP_UNKNOWN_COMMAND = 10, 7


class Condition(NamedTuple):
    """A vehicle's state at one instant, for GLOBAL_POSITION_INT and the messages of EXTRA."""

    time_boot_ms: int
    place_deg: tuple[float, float]
    """Latitude and longitude."""
    altitude_m: float
    """Above sea level."""
    velocity_ned_m_s: tuple[float, float, float]
    attitude_rad: tuple[float, float, float]
    """Roll, pitch, yaw."""
    flying: bool
    has_position: bool


def report(message_id: int, encoder: Encoder, condition: Condition) -> bytes:
    """The frame of GLOBAL_POSITION_INT or one of EXTRA."""
    north, east, down = condition.velocity_ned_m_s
    speed_m_s, heading_deg = math.hypot(north, east), math.degrees(condition.attitude_rad[2]) % 360.0
    if message_id == mavlink.GLOBAL_POSITION:
        # Without a position it sends zeros, as ArduPilot does.
        latitude_deg, longitude_deg = condition.place_deg if condition.has_position else (0.0, 0.0)
        return encoder.global_position(
            time_boot_ms=condition.time_boot_ms,
            latitude_deg=latitude_deg,
            longitude_deg=longitude_deg,
            altitude_m=condition.altitude_m,
            relative_altitude_m=condition.altitude_m - ORIGIN_ALTITUDE_M,
            velocity_ne_m_s=(north, east),
            velocity_down_m_s=down,
            heading_deg=heading_deg,
        )
    if message_id == SYS_STATUS:
        message = service_messages.sys_status(has_position=condition.has_position)
    elif message_id == EXTENDED_SYS_STATE:
        message = service_messages.extended_sys_state(IN_AIR if condition.flying else ON_GROUND)
    elif message_id == GPS_RAW:
        course_deg = math.degrees(math.atan2(east, north)) % 360.0
        time_us, fix = condition.time_boot_ms * 1000, condition.has_position
        message = service_messages.gps_raw(
            time_us, condition.place_deg, condition.altitude_m, speed_m_s, course_deg, fix=fix
        )
    elif message_id == ATTITUDE:
        message = service_messages.attitude(condition.time_boot_ms, condition.attitude_rad)
    elif message_id == BATTERY_STATUS:
        message = service_messages.battery_status()
    else:
        assert message_id == VFR_HUD
        message = service_messages.vfr_hud(speed_m_s, heading_deg, condition.altitude_m, -down)
    return encoder.pack(message)


class Services:
    """The parameters and message rates of one vehicle, and its answers about them.

    `defaults_us` holds the messages that can be requested, each with its default interval, 0 for none. No report is
    sent before `reports_from_ns`. `experiment` is the text of the parameter SCENARIO.
    """

    def __init__(
        self,
        encoder: Encoder,
        schedule: Schedule,
        parameters: Parameters,
        version: tuple[int, int, int],
        defaults_us: Mapping[int, int],
        reports_from_ns: int,
        experiment: str,
    ) -> None:
        self.parameters = parameters
        self.orphaned = False
        """Whether the station that started the simulation has gone, so that whoever flies now may end it."""
        self.shut_down_ns: int | None = None
        """When an orphaned vehicle was told to shut down."""
        self._experiment = experiment
        self._encoder = encoder
        self._schedule = schedule
        self._version = version
        self._defaults_us = {**dict.fromkeys(EXTRA, 0), **defaults_us}
        self._reports_from_ns = reports_from_ns

    def answer(self, request: Request, counters: Counter[str], time_ns: int) -> list[bytes]:
        """The frames that answer a request at once."""
        if isinstance(request, Mission):
            return [self._encoder.pack(_mission_answer(request))]
        if isinstance(request, FileTransfer):
            return [self._encoder.pack(_file_answer(request))]
        if isinstance(request, TextRead):
            if request.name != SCENARIO:
                return []
            return [self._encoder.pack(service_messages.text_value(SCENARIO, self._experiment))]
        if isinstance(request, DataStream):
            interval_us = max(SHORTEST_INTERVAL_US, round(1e6 / request.rate_hz)) if request.rate_hz else 0
            for message_id in STREAMS.get(request.stream, ()):
                if message_id in self._defaults_us:
                    self._set(message_id, interval_us, time_ns)
            return []
        assert not isinstance(request, service_messages.SetMode)
        frames = self.parameters.answer(request, self._encoder, counters)
        if self.parameters.listing:
            self._set(PARAMETER_VALUE, LIST_INTERVAL_US, time_ns)
        return frames

    def next_parameter(self, time_ns: int) -> bytes:
        """The next parameter of a list, at its scheduled instant."""
        frame = self.parameters.next_of_list(self._encoder)
        if not self.parameters.listing:
            self._set(PARAMETER_VALUE, 0, time_ns)
        return frame

    def command(self, command: Command, time_ns: int) -> tuple[int, list[service_messages.Message]]:
        """The MAV_RESULT of a command about messages, and what is sent right after it; reports are scheduled."""
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
        if message_id not in self._defaults_us or interval_us is None:
            return DENIED
        if interval_us == 0:
            interval_us = self._defaults_us[message_id]
        elif interval_us == -1:
            interval_us = 0
        elif not SHORTEST_INTERVAL_US <= interval_us < LONGEST_INTERVAL_US:
            return DENIED
        self._set(message_id, interval_us, time_ns)
        return ACCEPTED

    def _request(self, message_id: int | None, time_ns: int) -> int:
        if message_id not in self._defaults_us or time_ns < self._reports_from_ns:
            return DENIED
        self._schedule.add_once(message_id, time_ns)
        return ACCEPTED

    def _shut_down(self, time_ns: int) -> int:
        if not self.orphaned:
            return DENIED
        self.shut_down_ns = self.shut_down_ns or time_ns
        return ACCEPTED

    def _greet(self, time_ns: int) -> tuple[int, list[service_messages.Message]]:
        """Send AUTOPILOT_VERSION, and start the reports that a station which asks for it expects."""
        for message_id, interval_us in GREETED_US.items():
            if not self._schedule.interval_us(message_id):
                self._set(message_id, interval_us, time_ns)
        return ACCEPTED, [self._encoder.autopilot_version(self._version, parameters_bytewise=self.parameters.bytewise)]

    def _interval(self, message_id: int | None) -> tuple[int, list[service_messages.Message]]:
        if message_id not in self._defaults_us:
            return DENIED, []
        interval_us = self._schedule.interval_us(message_id) or -1
        return ACCEPTED, [service_messages.message_interval(message_id, interval_us)]

    def _set(self, message_id: int, interval_us: int, time_ns: int) -> None:
        if message_id != mavlink.HEARTBEAT:
            time_ns = max(time_ns, self._reports_from_ns)
        self._schedule.set_interval(message_id, interval_us, time_ns)


def whole(parameter: float) -> int | None:
    """A command's parameter as a whole number, or None if it is not one."""
    return int(parameter) if math.isfinite(parameter) and parameter == int(parameter) else None


def _mission_answer(request: Mission) -> service_messages.Message:
    """The answer of a vehicle whose lists are empty, can be cleared, and accept no items."""
    if request.asked == service_messages.MISSION_LIST:
        return service_messages.mission_count(request)
    if request.asked == service_messages.MISSION_CLEAR:
        return service_messages.mission_ack(request, service_messages.MISSION_ACCEPTED)
    if request.asked == service_messages.MISSION_COUNT:
        empty = request.number == 0
        result = service_messages.MISSION_ACCEPTED if empty else service_messages.MISSION_UNSUPPORTED
        return service_messages.mission_ack(request, result)
    return service_messages.mission_ack(request, service_messages.MISSION_NO_ITEM)


def _file_answer(request: FileTransfer) -> service_messages.Message:
    """The answer of a vehicle without files: opening one fails, ending a session works, the rest is unknown."""
    number = int.from_bytes(request.payload[:2], "little") + 1
    session, asked = request.payload[2:4]
    if asked in (FTP_TERMINATE, FTP_RESET):
        result, data = FTP_ACK, b""
    else:
        result, data = FTP_NAK, bytes([FTP_FILE_NOT_FOUND if asked in FTP_OPENS else FTP_UNKNOWN_COMMAND])
    header = (number & 0xFFFF).to_bytes(2, "little") + bytes([session, result, len(data), asked, 0, 0]) + bytes(4)
    return service_messages.file_transfer(request, header + data)
