"""Real terminals to run commands in: one of our own on a pseudo-terminal, and tmux where that is installed."""

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time  # noqa: TID251 - waits for other programs
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import pyte

from tests.support.processes import PATIENCE_S

PROMPT = "ready> "
_SHELL = "import fcntl, os, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execvp('sh', ['sh', '-i'])"
"""A shell whose terminal is the one it is given, so that Ctrl-C goes to what runs in it."""


class Terminal(Protocol):
    """A shell on a terminal."""

    def send(self, keys: str) -> None: ...

    def resize(self, columns: int, lines: int) -> None: ...

    def lines(self) -> list[str]:
        """What the screen shows now."""
        ...

    def cursor_shown(self) -> bool: ...


class Pseudo:
    """A pseudo-terminal drawn by pyte."""

    def __init__(self, columns: int, lines: int, environment: dict[str, str]) -> None:
        self._screen = pyte.Screen(columns, lines)
        self._stream = pyte.ByteStream(self._screen)
        self._end, terminal = pty.openpty()
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        self.process = subprocess.Popen(
            [sys.executable, "-c", _SHELL],
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            start_new_session=True,
            env=environment,
        )
        os.close(terminal)

    def send(self, keys: str) -> None:
        os.write(self._end, keys.encode())

    def resize(self, columns: int, lines: int) -> None:
        self.lines()
        self._screen.resize(lines, columns)
        fcntl.ioctl(self._end, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))

    def lines(self) -> list[str]:
        while select.select([self._end], [], [], 0)[0]:
            self._stream.feed(os.read(self._end, 65536))
        return [line.rstrip() for line in self._screen.display]

    def cursor_shown(self) -> bool:
        return not self._screen.cursor.hidden

    def close(self) -> None:
        self.process.kill()
        os.close(self._end)  # the shell and what runs in it are hung up on
        self.process.wait(PATIENCE_S)


class Tmux:
    """A window of a tmux server of its own."""

    def __init__(self, columns: int, lines: int, environment: dict[str, str], socket: Path) -> None:
        self._command = ["tmux", "-S", str(socket), "-f", "/dev/null"]
        self._environment = environment
        self._tmux("new-session", "-d", "-x", str(columns), "-y", str(lines), f"exec env PS1='{PROMPT}' sh -i")

    def send(self, keys: str) -> None:
        self._tmux("send-keys", "-H", *(f"{byte:02x}" for byte in keys.encode()))

    def resize(self, columns: int, lines: int) -> None:
        self._tmux("resize-window", "-x", str(columns), "-y", str(lines))

    def lines(self) -> list[str]:
        return self._tmux("capture-pane", "-p").splitlines()

    def cursor_shown(self) -> bool:
        return self._tmux("display-message", "-p", "#{cursor_flag}").strip() == "1"

    def close(self) -> None:
        self._tmux("kill-server")

    def _tmux(self, *arguments: str) -> str:
        command = [*self._command, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True, env=self._environment).stdout


@contextmanager
def terminal(kind: str, columns: int, lines: int, folder: Path) -> Generator[Terminal]:
    """A shell on a terminal of a kind, "pseudo" or "tmux", that shows its prompt."""
    environment = {**os.environ, "PS1": PROMPT, "TERM": "xterm-256color", "LANG": "C.UTF-8"}
    for name in ("TMUX", "ENV", "COLUMNS", "LINES", "NO_COLOR"):
        environment.pop(name, None)
    make = Pseudo(columns, lines, environment) if kind == "pseudo" else Tmux(columns, lines, environment, folder / "s")
    try:
        wait_for(lambda: _is_prompt(make), make)
        yield make
    finally:
        make.close()


def _is_prompt(shown: Terminal) -> bool:
    """Whether the shell waits for a command."""
    written = [line for line in shown.lines() if line]
    return bool(written) and written[-1] == PROMPT.rstrip()


def wait_for(condition: Callable[[], bool], shown: Terminal) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < give_up, "waited in vain; the screen shows\n" + "\n".join(shown.lines())
        time.sleep(0.05)


def rows(shown: Terminal, last_word: re.Pattern[str]) -> dict[int, list[str]]:
    """The table's rows that end in such a word, by the system id they begin with."""
    cells = [line.split() for line in shown.lines()]
    return {int(row[0]): row for row in cells if row and row[0].isdecimal() and last_word.fullmatch(row[-1])}


def is_restored(shown: Terminal) -> bool:
    """Whether the shell is back with a cursor, echo and lines that can be edited."""
    wait_for(lambda: _is_prompt(shown), shown)
    shown.send("stty -a; echo alive$((40 + 2))\r")
    wait_for(lambda: any(line == "alive42" for line in shown.lines()), shown)
    flags = " ".join(shown.lines()).replace(";", " ").split()
    return {"icanon", "echo", "isig", "opost"} <= set(flags) and shown.cursor_shown()
