"""Fly one formation over links of growing delay, and draw how its errors die away or grow.

    python examples/delay_sweep.py [PICTURE.png]

The monitor only watches: otherwise it would change to slower gains before the margin is reached.
"""

import sys

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from gcs import VirtualFlight, fly_virtual

LINK_DELAYS_S = (0.02, 0.08, 0.12, 0.16)
"""Each way."""


def flown() -> list[VirtualFlight]:
    """A flight for each link delay."""
    scenario = fly_virtual("chain3").scenario
    watching = scenario.model_copy(update={"monitor": scenario.monitor.model_copy(update={"act": False})})
    return [fly_virtual(watching.with_link_delay(up_s=delay_s, down_s=delay_s)) for delay_s in LINK_DELAYS_S]


def main() -> None:
    flights = flown()
    print(f"delay margin {flights[0].design.delay_margin_s:.3f} s")
    figure, plot = plt.subplots(layout="constrained")
    for flight in flights:
        loop_s = float(np.nanmedian(flight.loop_delay_s))
        print(f"loop delay {loop_s:.3f} s: {flight.summary.verdict}, least headroom {flight.summary.headroom_min:.0%}")
        error_m = np.linalg.norm(flight.spacing_error_ne_m, axis=2)[flight.time_s >= 0.0]
        plot.semilogy(
            flight.time_s[flight.time_s >= 0.0], np.nanmax(error_m, axis=1), label=f"loop delay {1e3 * loop_s:.0f} ms"
        )
    plot.set(xlabel="time [s]", ylabel="largest spacing error [m]", title="chain3, margin 300 ms")
    plot.legend()
    if len(sys.argv) > 1:
        figure.savefig(sys.argv[1])


if __name__ == "__main__":
    main()
