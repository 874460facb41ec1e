"""Runs the simulated vehicles of a flight in their own process."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Self

from gcs.runs.record import TRUTH_FILE
from gcs.runs.refusals import VEHICLES_FILE

VEHICLES_LOG = "vehicles.log"
ORPHAN_S = 60.0
"""How long vehicles whose station was killed fly on and wait for another station."""
_AT_ONCE_S = 0.1
_STOP_PATIENCE_S = 5.0


class VehicleProcess:
    """The simulated vehicles of a scenario in a child process, which is ended on leaving the context.

    With `outlive_station`, vehicles whose station is killed fly on in failsafe and can be taken over. They end once no
    station has commanded them for ORPHAN_S. Without it they end with this process.
    """

    def __init__(
        self,
        scenario_file: Path,
        *,
        station: tuple[str, int],
        folder: Path,
        key_file: Path | None = None,
        outlive_station: bool = False,
    ) -> None:
        host, port = station
        self._log = folder / VEHICLES_LOG
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [
                    sys.executable, "-m", "sim_vehicles.drive.cli", str(scenario_file), "--station", f"{host}:{port}",
                    "--truth", str(folder / TRUTH_FILE), "--parent", str(os.getpid()),
                    "--stop-after-silence", str(ORPHAN_S if outlive_station else _AT_ONCE_S),
                    "--counters", str(folder / VEHICLES_FILE),
                    *([] if key_file is None else ["--key", str(key_file)]),
                    "--allow-code",  # already permitted to this process, or it would not have come this far
                ],
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches only the station, which brings them to safety first
            )  # fmt: skip

    @property
    def pid(self) -> int:
        return self._process.pid

    def complaint(self) -> str:
        """The last line that the vehicles' process logged if it failed; empty while it runs, or if it was killed."""
        if (self._process.poll() or 0) <= 0:
            return ""
        lines = self._log.read_text(encoding="utf-8", errors="replace").split("\n")
        return f"vehicles ended: {next((line for line in reversed(lines) if line), 'they did not say why')}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self._process.wait(_STOP_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
