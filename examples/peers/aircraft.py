"""JSBSim's Cessna 172 in steady flight, without MAVLink: writes run time and length of a step to a JSON file."""

import json
import sys
import time  # noqa: TID251 - run time is what is measured
from importlib import import_module
from pathlib import Path
from typing import Any

SETTLING, STEPS = 600, 6000

jsbsim: Any = import_module("jsbsim")  # without types
aircraft = jsbsim.FGFDMExec(None)
aircraft.disable_output()
aircraft.load_model("c172x")
aircraft.disable_output()  # the model's own output, which would be written into this folder
aircraft["ic/h-sl-ft"], aircraft["ic/vc-kts"] = 3000.0, 100.0
aircraft.run_ic()
for _ in range(SETTLING):
    aircraft.run()
begun_s = time.perf_counter()
for _ in range(STEPS):
    aircraft.run()
figures = {"step_run_s": (time.perf_counter() - begun_s) / STEPS, "step_s": aircraft.get_delta_t()}
Path(sys.argv[1]).write_text(json.dumps(figures), encoding="utf-8")
