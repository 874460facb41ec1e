"""MAVLink 2 signing: signs what one system sends over one link, and verifies what it receives there.

This layer lies outside stations and vehicles. They get verified frames without signatures, so nothing else can change
their state. It follows the MAVLink guide, "Message Signing".

Decisions that the guide leaves open:

* A timestamp must be newer than all accepted ones of its stream (system, component, link id), as the guide demands.
  There is no window for older ones, so a frame that was overtaken on its way is refused. It is counted separately, as
  `overtaken`, if its timestamp is among the last `REMEMBERED` and was not seen: that is jitter, not an attack.
* A stream heard for the first time may be one minute behind. A stream known from before a restart is not new.
* No state is read or changed before the signature has been verified.
* No unsigned message is accepted, not even RADIO_STATUS, which nothing here reads.
* SETUP_SIGNING is refused even with a valid signature: keys are not accepted from a link.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from heapq import heappop, heappush
from hmac import compare_digest

from fastcrc.crc16 import mcrf4xx

from scenarios.signing.keys import Key
from scenarios.signing.stamps import Stamps

MAGIC_1, MAGIC = 0xFE, 0xFD
SIGNED = 0x01
HEADER, CHECKSUM, SIGNATURE = 10, 2, 13
SETUP_SIGNING = 256

EPOCH_NS = 1_420_070_400 * 10**9
"""2015-01-01, the zero of timestamps, in ns since 1970."""
TICK_NS = 10_000
MINUTE = 6_000_000
LARGEST = 2**48 - 1
REMEMBERED = 512

NOT_MAVLINK, VERSION_1, TRUNCATED, FLAGS = "not MAVLink", "MAVLink 1", "truncated", "unknown flags"
UNKNOWN, CHECKSUM_WRONG, UNSIGNED, WRONG = "unknown message", "bad checksum", "unsigned", "wrong signature"
REPLAYED, OVERTAKEN, TOO_OLD, SETUP = "replayed", "overtaken", "too old", "SETUP_SIGNING"
TOO_MANY = "too many signing streams"

_FLAG_IN_CHECKSUM = tuple(mcrf4xx(b"\0\1" + bytes(8 + n)) ^ mcrf4xx(bytes(10 + n)) for n in range(256))
"""How the flag SIGNED changes the checksum of a frame with n bytes of payload; the checksum is linear."""


class SignedLink:
    """One system's end of one link.

    `crc_extra` gives, for each message id, the byte that ends the checksummed data; `epoch_ns` is the time, in ns since
    1970, at which the clock of `now_ns` is 0. Where several ends share one `Stamps`, `owner` is the number of this end:
    the vehicle's system id, or the station's network.
    """

    def __init__(
        self, key: Key, *, link_id: int, crc_extra: Mapping[int, bytes], epoch_ns: int, stamps: Stamps, owner: int = 0
    ) -> None:
        self._key = key
        self._crc_extra = crc_extra
        self._offset_ns = epoch_ns - EPOCH_NS
        self._link_id = bytes([link_id])
        self._stamps = stamps
        of_owner = (owner & 0xFF) << 24 | owner >> 8 << 40
        self._streams = 1 << 32 | of_owner
        """High bits of the number of a received stream; system, component and link id are the low bits."""
        self._own = 1 << 33 | of_owner | link_id
        self._timestamp = stamps.known.get(self._own, 0)
        stamps.keep(self._own, self._timestamp)
        self._recent: dict[int, list[int]] = {}

    def sign(self, frame: bytes, now_ns: int) -> bytes:
        """Sign one of our frames, with a timestamp newer than any that this end has sent or heard."""
        assert (frame[0], frame[2]) == (MAGIC, 0)
        timestamp = min(LARGEST, max(self._timestamp + 1, (now_ns + self._offset_ns) // TICK_NS))
        self._timestamp = timestamp
        self._stamps.keep(self._own, timestamp)
        signed = _toggled(frame) + self._link_id + timestamp.to_bytes(6, "little")
        return signed + self._signature(signed)

    def verify(
        self, datagram: bytes, now_ns: int, refused: Counter[str], unwanted: Callable[[int], str] | None = None
    ) -> bytes:
        """The valid frames of a datagram, without their signatures; the others are counted by reason.

        `unwanted` may give a reason to refuse genuine frames of a system id, for example that they are copies: if a
        copy arrived first and were accepted, the frame itself would count as a replay.
        """
        good: list[bytes] = []
        at, end = 0, len(datagram)
        while at < end:
            if datagram[at] != MAGIC:
                refused[VERSION_1 if datagram[at] == MAGIC_1 else NOT_MAVLINK] += 1
                break
            if end - at < HEADER + CHECKSUM:
                refused[TRUNCATED] += 1
                break
            stop = at + HEADER + datagram[at + 1] + CHECKSUM + (SIGNATURE if datagram[at + 2] & SIGNED else 0)
            if stop > end:
                refused[TRUNCATED] += 1
                break
            frame = datagram[at:stop]
            reason = self._fault(frame) or (unwanted(frame[5]) if unwanted is not None else "")
            reason = reason or self._staleness(frame, now_ns)
            if reason:
                refused[reason] += 1
            else:
                good.append(_toggled(frame[:-SIGNATURE]))
            at = stop
        return b"".join(good)

    def _fault(self, frame: bytes) -> str:
        """Why a frame is not from a holder of the key, or "". The checksum only helps to name the reason."""
        number = frame[7] | frame[8] << 8 | frame[9] << 16
        if frame[2] & ~SIGNED or number == SETUP_SIGNING or number not in self._crc_extra:
            return FLAGS if frame[2] & ~SIGNED else SETUP if number == SETUP_SIGNING else UNKNOWN
        if frame[2] and compare_digest(self._signature(frame[:-6]), frame[-6:]):
            return ""
        unsigned = frame[:-SIGNATURE] if frame[2] else frame
        checksum = mcrf4xx(unsigned[1:-CHECKSUM] + self._crc_extra[number])
        if checksum != int.from_bytes(unsigned[-CHECKSUM:], "little"):
            return CHECKSUM_WRONG
        return WRONG if frame[2] else UNSIGNED

    def _staleness(self, frame: bytes, now_ns: int) -> str:
        """Why a verified frame is too old, or "", after which it is the newest of its stream."""
        stream = self._streams | frame[5] << 16 | frame[6] << 8 | frame[-13]
        timestamp = int.from_bytes(frame[-12:-6], "little")
        newest = self._stamps.known.get(stream, -1)
        recent = self._recent.get(stream, [newest])
        if timestamp <= newest:
            if timestamp <= recent[0] or timestamp in recent:
                return REPLAYED
            _remember(recent, timestamp)
            return OVERTAKEN
        if newest < 0 and timestamp + MINUTE < max(self._timestamp, (now_ns + self._offset_ns) // TICK_NS):
            return TOO_OLD
        if not self._stamps.keep(stream, timestamp):
            return TOO_MANY
        self._recent[stream] = recent
        _remember(recent, timestamp)
        self._timestamp = max(self._timestamp, timestamp)
        return ""

    def _signature(self, data: bytes) -> bytes:
        return hashlib.sha256(self._key.secret + data).digest()[:6]


def _toggled(frame: bytes) -> bytes:
    """A frame without its signature, with the flag SIGNED inverted and the checksum adjusted for that."""
    checksum = int.from_bytes(frame[-CHECKSUM:], "little") ^ _FLAG_IN_CHECKSUM[frame[1]]
    return frame[:2] + bytes([frame[2] ^ SIGNED]) + frame[3:-CHECKSUM] + checksum.to_bytes(2, "little")


def _remember(recent: list[int], timestamp: int) -> None:
    """Add a timestamp to the heap of a stream's newest: all that were seen and are newer than its first are in it."""
    heappush(recent, timestamp)
    if len(recent) > REMEMBERED:
        heappop(recent)
