"""Make the pictures in README and docs again, with the commands of a user; takes some minutes.

    python3 make.py pictures

The recording is drawn without a screen, by a software Vulkan driver (Debian and Ubuntu: apt install
mesa-vulkan-drivers).
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from docs.generate.blocks import ROOT

DOCS = ROOT / "docs"
SCENARIOS = ROOT / "scenarios"


def gcs(*arguments: str | Path) -> None:
    """Run a command of the ground station; CalledProcessError if it fails."""
    print("gcs", *arguments, flush=True)
    program = Path(sys.executable).with_name("gcs")
    subprocess.run([program, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        gcs("fly", SCENARIOS / "triangle5.toml", "--virtual", "--out", folder / "flight")
        gcs("view", folder / "flight", "--picture", folder / "flight.png", "--at", "1.2")
        gcs("fly", SCENARIOS / "delay_ramp.toml", "--virtual", "--out", folder / "ramp")
        gcs("view", folder / "ramp", "--picture", folder / "monitor.png", "--at", "45")
        gcs("stress", SCENARIOS / "chain3.toml", "--onset", "--delay", "0:0.6:7", "--out", folder / "onset")
        jitter = ["--delay", "0.15:0.375:10", "--jitter", "0:0.08:5", "--seeds", "3"]
        gcs("stress", SCENARIOS / "chain3.toml", *jitter, "--out", folder / "map")
        predicted = ["--delay", "0.15:0.85:8", "--jitter", "0:0.08:3", "--prediction", "0,0.6"]
        gcs("stress", SCENARIOS / "chain3.toml", *predicted, "--out", folder / "maps")
        gcs("thesis", "--out", folder / "thesis")
        shutil.copy(folder / "flight.png", DOCS / "flight.png")
        shutil.copy(folder / "monitor.png", DOCS / "monitor.png")
        shutil.copy(folder / "onset" / "growth.png", DOCS / "onset.png")
        shutil.copy(folder / "map" / "map.png", DOCS / "map.png")
        shutil.copy(folder / "maps" / "map.png", DOCS / "maps.png")
        shutil.copytree(folder / "thesis", DOCS / "thesis", dirs_exist_ok=True)


if __name__ == "__main__":
    main()
