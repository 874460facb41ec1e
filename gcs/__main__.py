"""The entry point of `gcs`. Its signal handlers end a command with one line of output, even during the imports."""

import contextlib
import os
import signal

from gcs.cli import INTERRUPTED
from gcs.interrupts import ending_signals
from gcs.output import open_what_is_closed


def main() -> None:
    for number in ending_signals():
        signal.signal(number, _end_at_once)
    open_what_is_closed()
    from gcs.cli.main import main as command

    command()


def _end_at_once(*_: object) -> None:
    with contextlib.suppress(OSError):  # the terminal may be closed
        os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    main()
