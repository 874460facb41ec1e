"""Shows a recording or a flight in progress: in the Rerun viewer, in a browser, or as a picture without a screen."""

import importlib.util
import os
import re
import socket
import subprocess
import sys
import tempfile
import time  # noqa: TID251 (waits for another program)
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from math import floor
from pathlib import Path
from typing import IO, Any, TypeVar

from gcs.errors import InputError, extra_wanted
from gcs.interrupts import raised
from gcs.runs.record import RECORDING_FILE, UNFINISHED_FILE

T = TypeVar("T")
START_S = 20.0
SETTLE_S = 20.0
DEFAULT_PICTURE_S = 10.0
_PICTURE_SIZE = "1600x900"
_MAGIC = b"RRF"
"""The first bytes of every .rrd file."""
_WANTED = "wanted a recording of a run (.rrd)"


def refuse_without_viewer() -> None:
    """Raise InputError if Rerun is not installed."""
    if importlib.util.find_spec("rerun") is None:
        raise InputError(extra_wanted("rerun"))


def view(recording: Path) -> int:
    """Open a recording in the Rerun viewer and wait until it is closed; returns its exit code."""
    _refuse_without_screen("--picture and --web need none")
    print(f"viewer   {recording}: until its window is closed", flush=True)
    return subprocess.run([_program(), str(recording)], check=False).returncode


def serve(recording: Path) -> int:
    """Serve a recording to the browsers of this machine until Ctrl-C; returns the server's exit code."""
    page, data = _free_port(), _free_port()
    ports = "--port", str(data), "--web-viewer-port", str(page)
    with _running(str(recording), "--serve-web", "--bind", "127.0.0.1", *ports) as (process, log):
        try:
            _wait_for(lambda: _listens("127.0.0.1", page) and _listens("127.0.0.1", data), process, log)
            at = f"http://127.0.0.1:{page}?url=rerun%2Bhttp%3A%2F%2Flocalhost%3A{data}%2Fproxy"
            at += "&theme=dark"  # the colours of vehicles and labels are chosen for it
            print(f"web      {at}\n         until Ctrl-C", flush=True)
            return process.wait()
        except KeyboardInterrupt:
            return 0


def new_viewer() -> str:
    """Open a viewer that waits for a flight, and return its URL. It stays open after the flight."""
    _refuse_without_screen("wanted --live HOST:PORT of a viewer elsewhere")
    port = _free_port()
    with tempfile.TemporaryFile() as log:
        process = _started(["--port", str(port)], log)
        _wait_for(lambda: _listens("127.0.0.1", port), process, log)
    return viewer_url("127.0.0.1", port)


def viewer_url(host: str, port: int) -> str:
    """The URL of the viewer that listens at an address; raises InputError if nothing listens there."""
    if not _listens(host, port):
        raise InputError(f"--live: nothing listens at {host}:{port}, wanted an open Rerun viewer (rerun --port {port})")
    return f"rerun+http://{host}:{port}/proxy"


def _refuse_without_screen(advice: str) -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(f"no screen here: neither DISPLAY nor WAYLAND_DISPLAY is set; {advice}")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _listens(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=2.0).close()
    except OSError:
        return False
    return True


def picture_time_s(recording: Path, wanted_s: float | None) -> float:
    """The scenario time of a picture: `wanted_s`, or by default ten seconds, or the end of the recording if sooner.

    Raises InputError if the recording ends before the wanted time, or contains no flight.
    """
    from gcs.views.recording import length_s  # Rerun is slow to import, and the viewer itself does not need it

    try:
        end_s = length_s(recording)
    except (OSError, RuntimeError, ValueError):  # cut short, or of another version
        end_s = None
    if end_s is None:
        raise InputError(f"{recording}: read no flight in it, {_WANTED}")
    if wanted_s is None:
        return min(DEFAULT_PICTURE_S, end_s)
    if not 0.0 <= wanted_s <= end_s:
        length = f"{floor(1e3 * end_s) / 1e3:g} s"
        raise InputError(f"--at: read {wanted_s:g}, wanted seconds from 0: {recording} is {length} long")
    return wanted_s


def screenshot(recording: Path, png: Path, *, time_s: float) -> list[str]:
    """Write a picture of the recording at a scenario time; returns the problems that the viewer's views report.

    Raises InputError if the viewer reads no flight, or if it does not start: it needs a Vulkan driver, but no screen.
    """
    from gcs.views.recording import TIMELINE

    with _headless() as viewer:
        viewer.open(str(recording.resolve()))
        try:
            viewer.set_time(TIMELINE, duration=time_s, play_state="paused")
        except ConnectionError:  # nothing with times was loaded
            raise InputError(f"{recording}: the viewer reads no flight in it, {_WANTED}") from None
        viewer.run_command("ui.toggle_top_panel")  # hides it: useless in a picture
        png.write_bytes(_settled_picture(viewer))
        state = viewer.get_state()
    if not state.views:
        raise InputError(f"{recording}: the viewer shows nothing of it, {_WANTED}")
    return [f"{shown.name}: {report}" for shown in state.views for report in shown.reports]


def find_recording(folder_or_rrd: Path) -> Path:
    """The finished recording in a run folder, or the given file itself; raises InputError if it is neither."""
    recording = folder_or_rrd / RECORDING_FILE if folder_or_rrd.is_dir() else folder_or_rrd
    if recording.is_file():
        with recording.open("rb") as opened:
            if opened.read(len(_MAGIC)) != _MAGIC:
                raise InputError(f"{recording}: read a file of another kind, {_WANTED}")
        return recording
    if not folder_or_rrd.is_dir():
        raise InputError(f"{folder_or_rrd}: read no such file, wanted a run folder or an .rrd file")
    if (folder_or_rrd / UNFINISHED_FILE).exists():
        read = "a recording that is not finished, as the run still flies or was killed"
        raise InputError(f"{folder_or_rrd}: read {read}, wanted a finished one")
    raise InputError(f"{folder_or_rrd}: read no {RECORDING_FILE}, wanted a run folder or an .rrd file")


def vulkan_missing() -> bool:
    """Whether no Vulkan driver is installed. Making a picture needs one."""
    folders = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
    return not any(any(Path(folder).glob("*.json")) for folder in folders)


@contextmanager
def _headless() -> Generator[Any]:
    """Run a viewer without a window, listening on a free local port, and yield its client."""
    if vulkan_missing():
        raise InputError("no Vulkan driver to draw with; on Debian and Ubuntu: apt install mesa-vulkan-drivers")
    from gcs.views.recording import viewer_client

    options = "--bind", "127.0.0.1", "--port", "0", "--window-size", _PICTURE_SIZE
    with _running("--headless", *options) as (process, log):
        yield viewer_client(_address(process, log))


@contextmanager
def _running(*arguments: str) -> Generator[tuple[subprocess.Popen[bytes], IO[bytes]]]:
    """Run the viewer while entered, and yield it with the file of its output."""
    with raised(), tempfile.TemporaryFile() as log:
        process = _started(arguments, log)
        try:
            yield process, log
        finally:
            process.terminate()
            process.wait()


def _settled_picture(viewer: Any) -> bytes:
    """The picture once three in a row are equal, or after SETTLE_S: all is then loaded, and notices have gone."""
    pictures = [viewer.take_screenshot()]
    give_up = time.monotonic() + SETTLE_S
    while pictures[-3:] != 3 * pictures[-1:] and time.monotonic() < give_up:
        pictures.append(viewer.take_screenshot())
    return pictures[-1]


def _started(arguments: Sequence[str], log: IO[bytes]) -> subprocess.Popen[bytes]:
    command = [_program(), *arguments]
    environment = os.environ | {"RERUN_APP_ONLY": "true"}  # as set by the package itself when it starts a viewer
    return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment, start_new_session=True)


def _wait_for(ready: Callable[[], T], process: subprocess.Popen[bytes], log: IO[bytes]) -> T:
    """Poll `ready` and return its first true value; raises InputError with the viewer's last line if none comes."""
    give_up = time.monotonic() + START_S
    while not (found := ready()):
        if process.poll() is not None or time.monotonic() > give_up:
            last = (_text(log).strip().splitlines() or ["it printed nothing"])[-1]
            raise InputError(f"the Rerun viewer does not start: {last}")
        time.sleep(0.02)
    return found


def _text(log: IO[bytes]) -> str:
    return os.pread(log.fileno(), 1 << 20, 0).decode(errors="replace")


def _address(process: subprocess.Popen[bytes], log: IO[bytes]) -> str:
    """The address of a starting viewer, once its log says that it listens there and that it draws."""

    def said() -> str:
        text = _text(log)
        address = re.search(r"rerun\+http://[0-9.:]+/proxy", text)
        return address.group() if address and "Headless viewer running" in text else ""

    return _wait_for(said, process, log)


def _program() -> str:
    """The path of the viewer's binary, which is part of the Python package."""
    package = importlib.util.find_spec("rerun_cli")
    program = Path(package.origin or "").parent / "rerun" if package else Path("rerun")
    if not program.is_file():
        raise InputError(extra_wanted("rerun_cli"))
    return str(program)
