"""What terminals show: text as it is, numbers, tables that fit, and pictures drawn anew.

What users, files and vehicles wrote is never read as markup.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from math import isnan

from rich import box
from rich.console import Console, RenderableType
from rich.live import Live
from rich.table import Column, Table
from rich.text import Text

UNKNOWN = "–"


def plain_console(*, stderr: bool = False, soft_wrap: bool = True) -> Console:
    """A console that reads no markup and no emoji codes in text; `soft_wrap` leaves long lines to the terminal.

    What is to have a style is a `rich.text.Text`.
    """
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False, soft_wrap=soft_wrap)


def number_text(value: float | None, form: str = ".5f", *, factor: float = 1) -> str:
    """A number times a factor, or a dash for None and NaN."""
    return UNKNOWN if value is None or isnan(value) else format(factor * value, form)


def ms_text(seconds: float | None, form: str = ".1f", *, unit: str = " ms") -> str:
    """A time in milliseconds."""
    return UNKNOWN if seconds is None or isnan(seconds) else f"{1e3 * seconds:{form}}{unit}"


def numbers_table(*headings: str, title: str | None = None) -> Table:
    """An empty table of columns that end on the right."""
    columns = (Column(heading, justify="right") for heading in headings)
    return Table(*columns, box=box.SIMPLE_HEAD, title=title, title_justify="left", title_style="")


def fitted_table(
    columns: Sequence[tuple[str, int, int]], rows: Iterable[Sequence[str | Text]], *, width: int, gap: int
) -> Table:
    """A table that leaves out columns on a narrow terminal.

    Each column has a heading, a least width, so that it stands still while its numbers change, and the width of the
    terminal from which it is shown.
    """
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, gap, 0, 0))
    shown = [k for k, (_, _, from_width) in enumerate(columns) if width >= from_width]
    for heading, least, _ in (columns[k] for k in shown):
        justify = "left" if heading in ("", "mode") else "right"
        table.add_column(heading, justify=justify, no_wrap=True, min_width=least)
    for row in rows:
        table.add_row(*(row[k] for k in shown))
    return table


def not_shown(count: int) -> list[Text]:
    """A line about vehicles for which there is no room, if there are any."""
    return [Text(f"  … {count} vehicles not shown, none of them worse", style="dim", no_wrap=True)] if count else []


@contextmanager
def live_display(*, shown: bool, transient: bool = False) -> Generator[Live | None]:
    """While entered, a picture on a terminal; None where there is no terminal, or nothing is to be shown."""
    console = plain_console(soft_wrap=False)
    if not (shown and console.is_terminal):
        yield None
        return
    with Live(console=console, auto_refresh=False, transient=transient) as live:
        yield live


def draw(live: Live, picture: Callable[[int, int], RenderableType]) -> None:
    """Draw a picture of a width and height; the terminal's last line stays free, or the cursor would scroll it."""
    live.update(picture(live.console.width, live.console.height - 1), refresh=True)
