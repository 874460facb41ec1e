"""Mirrors a flight to another ground station: all frames of the vehicles and of this station, as raw MAVLink.

By default it is read-only: frames from the other station are counted and dropped. Sending never blocks; frames that the
other station cannot take are counted.
"""

import contextlib
import socket
from collections import Counter
from collections.abc import Iterable
from typing import Self

from gcs.link import mavlink
from gcs.link.datagram import Outgoing
from gcs.link.kinds import SET_MESSAGE_INTERVAL
from gcs.link.vehicle import RemoteVehicle
from scenarios.signing.link import SignedLink

_LARGEST_DATAGRAM = 2048
_STREAMS_WITH_POSITION = (0, 6)
"""MAV_DATA_STREAM_ALL and MAV_DATA_STREAM_POSITION."""
_USED_MESSAGES = (
    *(mavlink.HEARTBEAT, mavlink.LOCAL_POSITION_NED, mavlink.GLOBAL_POSITION_INT, mavlink.GPS_GLOBAL_ORIGIN),
    *(mavlink.POSITION_TARGET_LOCAL_NED, mavlink.TIMESYNC, mavlink.EKF_STATUS_REPORT, mavlink.ESTIMATOR_STATUS),
)
"""Messages whose rates the other station may not change: the flight uses them."""
_DATAGRAMS_A_STEP = 64
"""Most datagrams read from the other station per step. The others wait in the socket buffer, which drops any excess."""


class Mirror:
    """A socket connected to another ground station; with `commands`, that station's frames are passed to the vehicles.

    All vehicles must be in one network, because the other station tells them apart by the system ids in frames.

    On a signed link, frames to the other station are signed and its own are accepted only if signed. Raises OSError if
    the address cannot be used.
    """

    def __init__(self, host: str, port: int, *, commands: bool, signed: SignedLink | None = None) -> None:
        self.counters: Counter[str] = Counter()
        self._commands = commands
        self._signed = signed
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))
        except OSError:
            self._socket.close()
            raise
        self.address = (str(self._socket.getpeername()[0]), port)
        self._socket.setblocking(False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def forward(self, frames: Iterable[bytes], now_ns: int) -> None:
        """Send frames to the other station, unchanged or, on a signed link, signed."""
        for frame in frames:
            try:
                # Signing needs MAVLink 2.
                self._socket.send(frame if self._signed is None else self._signed.sign(frame, now_ns))
                self.counters["forwarded"] += 1
            except OSError:  # nobody listened to an earlier datagram, or the buffer is full
                self.counters["not forwarded"] += 1

    def passed_on(self, vehicles: list[RemoteVehicle], now_ns: int) -> list[Outgoing]:
        """The permitted frames of the other station, each for the vehicle it is addressed to, or for all.

        They go only to vehicles that are, or were, in guided flight: one that was never commanded would accept the
        other station as its own. A frame for all is heard by all vehicles at a port: it is sent there once, and only
        if all of them may get it. Requests that change the rate of the telemetry used for control are refused, because
        displays ask for only a few positions a second when they connect.
        """
        own = {v.wire_id: v.address if v.guided or v.has_been_guided else None for v in vehicles}
        barred = {v.address for v in vehicles if own[v.wire_id] is None}
        to_all = [address for address in dict.fromkeys(own.values()) if address is not None and address not in barred]
        outgoing: list[Outgoing] = []
        for frame in self._received(now_ns):
            name = mavlink.message_name(frame.msg_id)
            target = mavlink.target_system(frame)
            addresses = to_all if target == 0 else [address for address in (own.get(target),) if address is not None]
            if not self._commands:
                self.counters[f"refused {name}"] += 1
            elif frame.system_id in own or not addresses:
                self.counters[f"refused {name} of or for a system that is not flown"] += 1
            elif _sets_our_rate(frame):
                self.counters[f"refused {name} about the rate of the telemetry used for control"] += 1
            else:
                self.counters[f"passed on {name}"] += 1
                outgoing += [(frame.data, address) for address in addresses]
        return outgoing

    def _received(self, now_ns: int) -> list[mavlink.Frame]:
        frames: list[mavlink.Frame] = []
        with contextlib.suppress(BlockingIOError):
            for _ in range(_DATAGRAMS_A_STEP):
                with contextlib.suppress(ConnectionError):  # nobody listened to an earlier datagram
                    data = self._socket.recv(_LARGEST_DATAGRAM)
                    refused: Counter[str] = Counter()
                    if self._signed is not None:
                        data = self._signed.verify(data, now_ns, refused)
                    frames += mavlink.decode_either(data, refused)
                    self.counters.update({f"refused: {reason}": count for reason, count in refused.items()})
        return frames


def _sets_our_rate(frame: mavlink.Frame) -> bool:
    """Whether a frame sets the rate of a message that the flight uses, alone or with the stream of positions."""
    name = mavlink.message_name(frame.msg_id)
    if name not in ("REQUEST_DATA_STREAM", "COMMAND_LONG", "COMMAND_INT"):
        return False
    fields = mavlink.named_fields(frame)
    if name == "REQUEST_DATA_STREAM":
        return fields["req_stream_id"] in _STREAMS_WITH_POSITION
    return fields["command"] == SET_MESSAGE_INTERVAL and fields["param1"] in _USED_MESSAGES
