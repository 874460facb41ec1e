"""Signing at the vehicles' ends of their links: one end for each vehicle, all with the same key."""

from collections.abc import Iterable
from pathlib import Path

from scenarios.signing.keys import Key, read_key
from scenarios.signing.link import SignedLink
from scenarios.signing.stamps import Stamps, open_stamps
from sim_vehicles.services.mavlink import CRC_EXTRA

LINK_ID = 0
"""Link id in signatures. One is enough, as each vehicle has one socket."""


def signed_links(key: Key, system_ids: Iterable[int], *, epoch_ns: int, stamps: Stamps) -> dict[int, SignedLink]:
    """The vehicles' ends by system id; `epoch_ns` is the time, in ns since 1970, at which their clock is 0."""
    return {
        system_id: SignedLink(
            key, link_id=LINK_ID, crc_extra=CRC_EXTRA, epoch_ns=epoch_ns, stamps=stamps, owner=system_id
        )
        for system_id in system_ids
    }


def open_links(key_file: Path, system_ids: Iterable[int], *, epoch_ns: int) -> dict[int, SignedLink]:
    """The vehicles' ends with the key in a file; the newest timestamps are kept in a file beside it.

    Raises KeyFileError if one of the files cannot be used.
    """
    key = read_key(key_file)
    stamps = open_stamps(key_file.with_name(key_file.name + ".vehicles"))
    return signed_links(key, system_ids, epoch_ns=epoch_ns, stamps=stamps)
