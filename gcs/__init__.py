"""The ground station: flies formations over MAVLink and compares measured loop delay with the delay margin.

From Python, `load_scenario` reads a scenario, `with_gain` gives it your own gains, and `fly_virtual` flies it in
virtual time. `front` searches the best figures reachable at each loop delay; `plot_front`, `plot_growth` and
`plot_root_locus` draw. Your own control law is called with a `LawFormation`. Each name is imported on first use.
"""

import os

# Set before numpy is loaded: the matrices are small, and BLAS threads on shared cores made the work 10 times slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

TYPE_CHECKING = False
if TYPE_CHECKING:
    from gcs.plan.given import with_gain
    from gcs.plan.own_law import LawFormation
    from gcs.studies.front import front, plot_front
    from gcs.studies.virtual import VirtualFlight, fly_virtual, load_scenario
    from gcs.views.plots import plot_growth, plot_root_locus

__all__ = [
    "LawFormation", "VirtualFlight", "fly_virtual", "front", "load_scenario", "plot_front", "plot_growth",
    "plot_root_locus", "with_gain",
]  # fmt: skip

_NAMES = {
    "studies.virtual": "VirtualFlight fly_virtual load_scenario",
    "plan.given": "with_gain",
    "plan.own_law": "LawFormation",
    "studies.front": "front plot_front",
    "views.plots": "plot_growth plot_root_locus",
}
_HOME = {name: f"gcs.{module}" for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOME[name]), name)
