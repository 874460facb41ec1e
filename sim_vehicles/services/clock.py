"""A vehicle's boot clock: an offset and a drift from the host's clock, in exact integers."""

from dataclasses import dataclass
from typing import Self

from scenarios.kernel import kernel
from scenarios.schema import NS_PER_S, Clocks
from sim_vehicles.services.draws import Use, draws_of

NS_PER_MS = 1_000_000


@kernel
def boot_ns(start_ns: int, offset_ns: int, drift_ppb: int, host_ns: int) -> int:
    """Boot time that a clock shows. Whole seconds are multiplied separately: no product then exceeds 64 bits."""
    whole, rest = divmod(host_ns - start_ns, NS_PER_S)
    return offset_ns + (host_ns - start_ns) + whole * drift_ppb + rest * drift_ppb // NS_PER_S


@kernel
def host_ns(start_ns: int, offset_ns: int, drift_ppb: int, boot_ns: int) -> int:
    """The earliest host time (ns) at which a clock shows at least `boot_ns`."""
    whole, rest = divmod(offset_ns - boot_ns, NS_PER_S + drift_ppb)
    return start_ns - whole * NS_PER_S - rest * NS_PER_S // (NS_PER_S + drift_ppb)


@dataclass(frozen=True)
class BootClock:
    """Converts host time (CLOCK_MONOTONIC, or the virtual clock) to boot time and back in exact integers."""

    start_ns: int
    """Host time at which the clock shows `offset_ns`."""
    offset_ns: int
    drift_ppb: int

    @classmethod
    def draw(cls, clocks: Clocks, seed: int, system_id: int, start_ns: int) -> Self:
        """Draw a vehicle's clock from the scenario's seed: offset from 0 to its bound, drift within ± its bound."""
        offset, drift = draws_of(seed, system_id, Use.CLOCK).random(2)
        offset_ns = int(offset * clocks.offset_max_s * NS_PER_S)
        return cls(start_ns, offset_ns, round((2.0 * drift - 1.0) * clocks.drift_max_ppm * 1000.0))

    def boot_ns(self, host_time_ns: int) -> int:
        return boot_ns(self.start_ns, self.offset_ns, self.drift_ppb, host_time_ns)

    def host_ns(self, boot_time_ns: int) -> int:
        """The earliest host time (ns) at which the clock shows at least `boot_time_ns`."""
        return host_ns(self.start_ns, self.offset_ns, self.drift_ppb, boot_time_ns)


NEVER_NS = 2**63 - 1
