"""MAVLink systems of pymavlink's that sign what they send, for the tests."""

import hashlib
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

KEY, OTHER_KEY = (hashlib.sha256(name.encode()).digest() for name in ("a key", "another"))
EPOCH_NS = 1_800_000_000 * 10**9
NOW_NS = 5 * 10**9
NOW = (EPOCH_NS + NOW_NS - 1_420_070_400 * 10**9) // 10_000
"""The signing timestamp of NOW_NS: 10 µs since 2015-01-01."""


def a_sender(*, key: bytes | None = KEY, timestamp: int = NOW, link_id: int = 0, system: int = 1) -> Any:
    """A MAVLink system of pymavlink's."""
    mav: Any = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
    mav.robust_parsing = True
    if key is not None:
        mav.signing.secret_key = key
        mav.signing.sign_outgoing = True
        mav.signing.timestamp = timestamp
        mav.signing.link_id = link_id
    return mav


def position(mav: Any, north_m: float = 1.5) -> bytes:
    frame: bytes = dialect.MAVLink_local_position_ned_message(7, north_m, 2.0, -3.0, 4.0, 5.0, 0.0).pack(mav)
    mav.seq = (mav.seq + 1) % 256
    return frame


def stamp(frame: bytes) -> int:
    return int.from_bytes(frame[-12:-6], "little")
