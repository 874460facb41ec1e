"""Signs and verifies datagrams at the station's socket; the station itself handles only unsigned frames."""

from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from gcs.link import mavlink
from gcs.link.datagram import Datagram, Outgoing, network_at
from gcs.station.reception import ANOTHER_ADDRESS
from scenarios.signing.keys import Key, read_key
from scenarios.signing.link import SignedLink
from scenarios.signing.stamps import Stamps, open_stamps

LINK_ID, MIRROR_LINK_ID = 0, 1
"""Signing link ids of the socket to the vehicles and of the socket to another station."""


class Guard:
    """Signs outgoing datagrams; verifies incoming ones and removes their signatures."""

    def __init__(self, key: Key, *, epoch_ns: int, stamps: Stamps) -> None:
        self._end = partial(SignedLink, key, crc_extra=mavlink.CRC_EXTRA, epoch_ns=epoch_ns, stamps=stamps)
        self._links: dict[int, SignedLink] = {}
        """The station's end of the link to each network, created when a network is first heard or sent to."""
        self.mirror_link = self._end(link_id=MIRROR_LINK_ID)

    def _link(self, network: int) -> SignedLink:
        if network not in self._links:
            self._links[network] = self._end(link_id=LINK_ID, owner=network)
        return self._links[network]

    def received(
        self,
        datagrams: Iterable[Datagram],
        now_ns: int,
        refused: Counter[str],
        is_another: Callable[[int, Datagram], bool] | None = None,
    ) -> list[Datagram]:
        """The datagrams reduced to their verified frames; refused frames are counted by reason.

        `is_another` says whether a datagram claims a known system id from another address, see `Reception`.
        """
        verified: list[Datagram] = []
        for datagram in datagrams:

            def unwanted(system_id: int, datagram: Datagram = datagram) -> str:
                return ANOTHER_ADDRESS if is_another is not None and is_another(system_id, datagram) else ""

            good = self._link(network_at(datagram.address)).verify(datagram.data, now_ns, refused, unwanted)
            if good:
                verified.append(Datagram(good, *datagram[1:]))
        return verified

    def sent(self, outgoing: Iterable[Outgoing], now_ns: int) -> list[Outgoing]:
        return [(self._link(network_at(address)).sign(data, now_ns), address) for data, address in outgoing]


def open_guard(key_file: Path, *, epoch_ns: int, role: str) -> Guard:
    """A guard with the key in a file. Signing timestamps are kept beside that file, in one file for each role.

    Raises KeyFileError if one of the files cannot be used.
    """
    key = read_key(key_file)
    return Guard(key, epoch_ns=epoch_ns, stamps=open_stamps(key_file.with_name(f"{key_file.name}.{role}")))
