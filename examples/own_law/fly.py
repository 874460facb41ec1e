"""Fly a user's control law, and the linear law that it equals for small errors.

    python examples/own_law/fly.py

The linear law states its gain matrix, so its delay margin is known; gcs stress --onset finds that of the other.
"""

from pathlib import Path

import numpy as np

from gcs import fly_virtual
from scenarios.files import load

HERE = Path(__file__).parent


def main() -> None:
    scenario = load(HERE / "chain.toml")
    stated = scenario.control.model_copy(update={"controller": "soft.py:linear", "linear": "soft.py:matrices"})
    for name, flown in (("soft", scenario), ("linear", scenario.model_copy(update={"control": stated}))):
        flight = fly_virtual(flown, allow_code=True)
        margin_s, most_m_s2 = flight.design.delay_margin_s, float(np.nanmax(np.abs(flight.command_ne_m_s2)))
        margin = f"unknown: {flight.design.margin_unknown}" if margin_s is None else f"{margin_s:.3f} s"
        print(f"{name}: {flight.summary.verdict}, commands up to {most_m_s2:.1f} m/s² an axis, delay margin {margin}")


if __name__ == "__main__":
    main()
