"""The terminal, on which text is shown as it is: what users, files and vehicles wrote is never read as markup."""

from rich.console import Console


def plain_console(*, stderr: bool = False, soft_wrap: bool = True) -> Console:
    """A console that reads no markup and no emoji codes in text; `soft_wrap` leaves long lines to the terminal.

    What is to have a style is a `rich.text.Text`.
    """
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False, soft_wrap=soft_wrap)
