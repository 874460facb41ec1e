"""Prepares the process that `docs.generate.forked` forks: it has imported the project and flown.

Importing this module flies for a second, which loads the kernels.
"""

from importlib import import_module

from gcs import fly_virtual
from scenarios.files import load
from scenarios.shipped import FOLDER

for name in ("gcs.cli.main", "gcs.preflight.check", "gcs.drive.fly", "gcs.views.flight_report"):
    import_module(name)
fly_virtual(load(FOLDER / "chain3.toml").model_copy(update={"duration_s": 1.0}))
