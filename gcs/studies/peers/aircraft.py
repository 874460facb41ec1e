"""JSBSim's Cessna 172 in steady flight, without any MAVLink: the time of a step and its length.

Its argument is the folder to leave them in.
"""

import sys
import time  # noqa: TID251 - run time is what is measured
from importlib import import_module
from pathlib import Path
from typing import Any

from gcs.studies.peers.figures import write_figures

_SETTLING, _STEPS = 600, 6000


def main() -> None:
    jsbsim: Any = import_module("jsbsim")
    aircraft = jsbsim.FGFDMExec(None)
    aircraft.load_model("c172x")
    aircraft["ic/h-sl-ft"], aircraft["ic/vc-kts"] = 3000.0, 100.0
    aircraft.run_ic()
    for _ in range(_SETTLING):
        aircraft.run()
    begun_s = time.perf_counter()
    for _ in range(_STEPS):
        aircraft.run()
    taken_s = (time.perf_counter() - begun_s) / _STEPS
    write_figures(Path(sys.argv[1]), {"step_run_s": taken_s, "step_s": aircraft.get_delta_t()})


if __name__ == "__main__":
    main()
