"""The start of `gcs`: Ctrl-C ends it in one line from here on, also while it imports."""

import os
import signal

from gcs.interrupts import EXIT_INTERRUPTED


def main() -> None:
    """Entry point."""
    signal.signal(signal.SIGINT, _end)
    from gcs.cli import main as command

    command()


def _end(*_: object) -> None:
    """End at once: where something has to be brought to an end first, `gcs.interrupts.raised` is in force."""
    os.write(2, b"interrupted\n")
    os._exit(EXIT_INTERRUPTED)


if __name__ == "__main__":
    main()
