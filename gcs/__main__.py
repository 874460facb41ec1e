"""The start of `gcs`: the signals that end a command do so in one line from here on, also while it imports."""

from gcs.interrupts import end_at_once
from gcs.output import open_what_is_closed


def main() -> None:
    """Entry point."""
    end_at_once()
    open_what_is_closed()
    from gcs.cli.main import main as command

    command()


if __name__ == "__main__":
    main()
