"""The ground station: flies formations over MAVLink and compares measured loop delay with the delay margin.

From Python, `fly_virtual` flies a scenario in virtual time, and `LawFormation` is what a control law of one's own is
called with; importing a name loads what it needs.
"""

import os

# Before numpy is loaded: the matrices are small, and several BLAS threads on shared cores made them ten times slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

TYPE_CHECKING = False
if TYPE_CHECKING:
    from gcs.drive.virtual import VirtualFlight, fly_virtual
    from gcs.plan.own_law import LawFormation

__all__ = ["LawFormation", "VirtualFlight", "fly_virtual"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("gcs.plan.own_law" if name == "LawFormation" else "gcs.drive.virtual"), name)
