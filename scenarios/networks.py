"""Formations of several networks: MAVLink has 250 system ids for vehicles, so more vehicles need more networks.

Each network has a UDP port of its own at the station. A system id above 1000 names a vehicle outside network 0: 2017 is
the vehicle with MAVLink system id 17 in network 2.
"""

from collections.abc import Iterable

NETWORK = 1000
"""A system id is this times the number of the network, plus the id in the frames of that network."""
MOST_IN_NETWORK, LAST_NETWORK = 250, 9
LARGEST_ID = LAST_NETWORK * NETWORK + MOST_IN_NETWORK
MOST_VEHICLES = 1000
"""The largest formation."""


def wire_id(system_id: int) -> int:
    """The MAVLink system id of a vehicle, which its frames carry."""
    return system_id % NETWORK


def network_of(system_id: int) -> int:
    """The network of a vehicle."""
    return system_id // NETWORK


def system_id_of(network: int, wire_id: int) -> int:
    """The system id of the vehicle that has this id in the frames of a network."""
    return network * NETWORK + wire_id


def networks_of(system_ids: Iterable[int]) -> list[int]:
    """The networks of some vehicles, in order."""
    return sorted({*map(network_of, system_ids)})


def ids_of(count: int) -> list[int]:
    """System ids for a formation: 1 to 250 in network 0, then 1001 to 1250 in network 1, and so on."""
    return [k // MOST_IN_NETWORK * NETWORK + k % MOST_IN_NETWORK + 1 for k in range(count)]
