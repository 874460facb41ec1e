"""How much processor time a mismatch window takes, for each kind of loop that is predicted.

`python -m docs.generate.certificates` computes the sampled and the continuous window of each at five assumed delays,
and prints the longest time of each: of five runs at the same delay, the fastest counts.
"""

import argparse
import json
import time  # noqa: TID251 - run time is what is measured
from collections.abc import Callable

import numpy as np

from docs.generate.blocks import ROOT, table
from docs.generate.runner import Runner
from gains.formation.model import FormationModel
from gains.performance.response import Response
from gains.sampled.multirate import Timing
from gcs.plan.mismatch import Predicted, continuous_window, window
from gcs.plan.planner import flight_plan
from scenarios.files import load

COMMAND = "python -m docs.generate.certificates"
_ASSUMED_S, _RUNS = (0.3, 0.6, 1.0, 1.5, 3.0), 5


def certificates(runner: Runner) -> str:
    """A row for each kind of loop: the longest time of its sampled window, and of its continuous one."""
    found = runner.json(COMMAND)
    rows = [(kind, f"{own['sampled_ms']:.0f} ms", f"{own['continuous_ms']:.0f} ms") for kind, own in found.items()]
    return table(("predicted loop", "sampled window", "continuous window"), rows)


def _loops() -> dict[str, Predicted]:
    """One formation of each kind: five vehicles in two axes, or the three of `thesis_delay`."""
    model, own = FormationModel((-1, 0, 1, 0, 3)), np.eye(2)
    fast, slow = (model.overlapping_gain(-c * 3.408 * own, c * 0.631 * own, c * c * 5.608 * own) for c in (1.0, 0.5))

    def loop(K: np.ndarray, timing: Timing, response: Response | None = None) -> Predicted:
        return Predicted(model, K.tobytes(), timing, None if response is None else (response,) * model.vehicles)

    at_50_hz, dead = Timing(0.02, 0.02), Response(0.15, 0.0, 0.05)
    thesis = load(ROOT / "scenarios/thesis_delay.toml")
    thesis = thesis.with_keys(control={"prediction": 1.0})
    plan = flight_plan(thesis)[1]
    return {
        "vehicles that respond at once, 50 Hz": loop(fast, at_50_hz),
        "lag of 0.15 s": loop(fast, at_50_hz, Response(0.15, 0.0)),
        "lag of 0.15 s, dead time of 0.05 s": loop(slow, at_50_hz, dead),
        "second order, 10 rad/s": loop(slow, at_50_hz, Response(0.14, 0.0, 0.0, 10.0)),
        "on board, `thesis_delay`": plan.predicted(plan.gain),
        "control 50 Hz, telemetry 10 Hz": loop(fast, Timing(0.02, 0.1)),
        "control 200 Hz, telemetry 30 Hz": loop(fast, Timing(1.0 / 200.0, 1.0 / 30.0)),
        "the same with lag and dead time": loop(slow, Timing(1.0 / 200.0, 1.0 / 30.0), dead),
        "control 5 Hz, telemetry 1.289 Hz": loop(slow, Timing(1.0 / 5.0, 1.0 / 1.289)),
    }


def _least_ms(work: Callable[[Predicted, float], object], loop: Predicted, assumed_s: float) -> float:
    taken: list[float] = []
    for _ in range(_RUNS):
        begun_s = time.process_time()
        work(loop, assumed_s)
        taken.append(time.process_time() - begun_s)
    return 1e3 * min(taken)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON and nothing else")
    parser.parse_args()
    found = {
        kind: {
            "sampled_ms": max(_least_ms(window.__wrapped__, loop, assumed_s) for assumed_s in _ASSUMED_S),
            "continuous_ms": max(_least_ms(continuous_window, loop, assumed_s) for assumed_s in _ASSUMED_S),
        }
        for kind, loop in _loops().items()
    }
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
