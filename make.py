"""Set up the project and run its main jobs; needs nothing but Python >= 3.11.

`python3 make.py fly` flies the main scenario, `python3 make.py test` runs the tests.
Each makes .venv first, from requirements.lock, and does nothing there if it is already up to date.
"""

import argparse
import fcntl
import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
STAMP = VENV / "installed.sha256"
LOCK = ROOT / "requirements.lock"

# name: (what it is for, the commands; further arguments go to the last one)
JOBS: dict[str, tuple[str, list[str]]] = {
    "setup": ("make .venv with everything in requirements.lock, compile the kernels", ["python --version"]),
    "fly": ("fly scenarios/triangle5.toml", ["gcs fly scenarios/triangle5.toml"]),
    "test": ("run the tests", ["python -m pytest -n auto"]),
    "soak": (
        "fly random experiments in virtual time and check invariants: --flights N --seed S [--workers W]",
        ["python -m tests.soak"],
    ),
    "clients": (
        "fly the vehicles under MAVProxy and MAVSDK's server, which it installs (1.2 GB)",
        ["uv pip install --quiet --group clients", "python -m pytest -n 0 -rs tests/clients/test_clients.py"],
    ),
    "peers": (
        "compare with other people's tools, which it installs, and print ratios: gcs bench --peers",
        ["uv pip install --quiet --group peers", "gcs bench scenarios/triangle5.toml --peers"],
    ),
    "lint": (
        "check format, style, types and import contracts",
        ["ruff format --check .", "ruff check .", "pyrefly check", "lint-imports"],
    ),
    "format": ("format the code", ["ruff check --fix-only .", "ruff format ."]),
    "pictures": (
        "make the pictures in README and docs again, from flights and designs",
        ["python -m docs.generate.pictures"],
    ),
    "reference": (
        "rewrite the generated reference and the scenarios' JSON Schema, from the code (--check: only compare)",
        ["python -m docs.generate reference"],
    ),
    "measurements": (
        "measure the figures in README and docs again: NAMEs or all; --timed: those in real time; --check: compare",
        ["python -m docs.generate measurements"],
    ),
    "docs": (
        "build the documentation as a site in build/site, with packages that it installs",
        ["uv pip install --quiet --group docs", "mkdocs build --strict"],
    ),
    "lock": (
        "rewrite requirements.lock from pyproject.toml",
        [
            "uv pip compile --upgrade --universal --generate-hashes --no-header --no-emit-index-url "
            "--all-extras --group dev pyproject.toml -o requirements.lock"
        ],
    ),
}


def install() -> None:
    """Bring .venv to the state that requirements.lock and pyproject.toml describe."""
    wanted = hashlib.sha256(LOCK.read_bytes() + (ROOT / "pyproject.toml").read_bytes()).hexdigest()
    if STAMP.exists() and STAMP.read_text() == wanted:
        return
    python = VENV / "bin" / "python"
    if not python.exists():
        print(f"making {VENV}", flush=True)
        if subprocess.run([sys.executable, "-m", "venv", str(VENV)], check=False).returncode != 0:
            sys.exit("python could not make a virtual environment; on Debian and Ubuntu: apt install python3-venv")
    print("installing the locked packages (half a minute the first time)", flush=True)
    pip = [str(python), "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    locked = ["--require-hashes", "-r", str(LOCK)]
    if not _installed_by_uv(python, pip, locked):  # uv does not read the settings of pip, such as its index
        print("uv could not install them, pip tries", flush=True)
        subprocess.run([*pip, *locked], check=True)
    subprocess.run([*pip, "--no-deps", "--no-build-isolation", "--editable", str(ROOT)], check=True)
    STAMP.write_text(wanted)


def compile_kernels() -> None:
    """Compile what runs for every frame; otherwise the first flight would."""
    print("compiling what runs for every frame (one or two minutes; kept in ~/.cache/formation-gcs)", flush=True)
    flight = [str(VENV / "bin" / "gcs"), "bench", "chain3", "--seconds", "1", "--repeat", "1"]
    subprocess.run(flight, check=True, stdout=subprocess.DEVNULL, cwd=VENV)


def _installed_by_uv(python: Path, pip: list[str], locked: list[str]) -> bool:
    """Try to install uv and, with it, the locked packages, in half of pip's time; whether that worked."""
    pinned = re.search(r"^uv==.*(\n +--hash.*)+", LOCK.read_text(), re.MULTILINE)
    own = [*pip, "--require-hashes", "-r", "/dev/stdin"]
    if pinned is None or subprocess.run(own, input=pinned[0], text=True, check=False).returncode != 0:
        return False
    install = [str(VENV / "bin" / "uv"), "pip", "install", "--quiet", "--python", str(python)]
    return subprocess.run([*install, *locked], check=False).returncode == 0


def main() -> None:
    if sys.version_info < (3, 11):
        sys.exit(f"python {sys.version.split()[0]} is too old: wanted 3.11 or newer")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    jobs = parser.add_subparsers(dest="job", required=True, metavar="JOB")
    for name, (text, _) in JOBS.items():
        jobs.add_parser(name, help=text)
    chosen, further = parser.parse_known_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # otherwise every command would compile its imports again
    try:
        with Path(__file__).open() as own:
            fcntl.flock(own, fcntl.LOCK_EX)  # of several jobs at once, the first installs
            install()
        if chosen.job == "setup":
            compile_kernels()
    except subprocess.CalledProcessError as error:
        sys.exit(f"installation failed: {' '.join(error.cmd)}")
    os.chdir(ROOT)
    *first, last = [[str(VENV / "bin" / line.split()[0]), *line.split()[1:]] for line in JOBS[chosen.job][1]]
    for command in first:
        status = subprocess.run(command, check=False).returncode
        if status != 0:
            sys.exit(status)
    # The last command takes this process over, so that Ctrl-C reaches it alone and its exit code is ours.
    os.execv(last[0], [*last, *further])


if __name__ == "__main__":
    main()
