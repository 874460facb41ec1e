"""Terminal output: literal text, numbers, tables that fit, live displays and progress bars.

Text from users, files and vehicles is never interpreted as markup.
"""

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from math import isnan
from typing import TypeVar

from rich import box
from rich.console import Console, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from gcs.errors import beyond

UNKNOWN = "–"
_MOST_NAMED = 12
"""Most vehicles named in a line."""

Item = TypeVar("Item")
FittedColumn = tuple[str, int, int, Callable[[Item], str | Text]]
"""Heading, least width, least terminal width at which the column is shown, and the text for an item."""


def plain_console(*, stderr: bool = False, soft_wrap: bool = True) -> Console:
    """A console that interprets no markup or emoji codes; `soft_wrap` leaves wrapping of long lines to the terminal.

    Pass a `rich.text.Text` for styled output.
    """
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False, soft_wrap=soft_wrap)


def number_text(value: float | None, form: str = ".5f", *, factor: float = 1) -> str:
    """A number times a factor, or a dash for None and NaN."""
    return UNKNOWN if value is None or isnan(value) else format(factor * value, form)


def ms_text(seconds: float | None, form: str = ".1f", *, unit: str = " ms") -> str:
    """A time in milliseconds, or a dash for None and NaN."""
    return UNKNOWN if seconds is None or isnan(seconds) else f"{1e3 * seconds:{form}}{unit}"


def growth_text(factor: float | None) -> str:
    """In words, the growth of errors: by at most `factor`, or unbounded (None). Up to 1 + 1e-6 counts as rounding.

    >>> growth_text(1.0), growth_text(1.004), growth_text(1.15), growth_text(None)
    ('do not grow', 'grow at most 1.004 times', 'grow at most 1.15 times', 'grow without bound')
    """
    if factor is None:
        return "grow without bound"
    return "do not grow" if factor <= 1.0 + 1e-6 else f"grow at most {beyond(factor, 1.0, 2)} times"


def table_of(
    items: Iterable[Item],
    columns: Mapping[str, Callable[[Item], str]],
    *,
    title: str | None = None,
    dense: bool = False,
    is_dim: Callable[[Item], bool] = lambda _: False,
) -> Table:
    """A table with a row for each item; `columns` maps each heading to the function that gives an item's text.

    Columns are right-aligned, except those without a heading.
    """
    padding = (0, 1, 0, 0) if dense else (0, 1)
    table = Table(box=box.SIMPLE_HEAD, padding=padding, title=title, title_justify="left", title_style="")
    for heading in columns:
        table.add_column(heading, justify="right" if heading else "left", no_wrap=dense)
    for item in items:
        table.add_row(*(text(item) for text in columns.values()), style="dim" if is_dim(item) else "")
    return table


def fitted_table(items: Iterable[Item], columns: Sequence[FittedColumn[Item]], *, width: int, gap: int) -> Table:
    """A table that omits columns on a narrow terminal; column positions stay fixed while the numbers change."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, gap, 0, 0))
    shown = [column for column in columns if width >= column[2]]
    for heading, least, _, _ in shown:
        justify = "left" if heading in ("", "mode") else "right"
        table.add_column(heading, justify=justify, no_wrap=True, min_width=least)
    for item in items:
        table.add_row(*(text(item) for *_, text in shown))
    return table


def not_shown(count: int) -> list[Text]:
    """A line with the number of vehicles not shown for lack of room, if any."""
    return [Text(f"  … {count} vehicles not shown, none of them worse", style="dim", no_wrap=True)] if count else []


@contextmanager
def live_display(*, shown: bool, transient: bool = False) -> Generator[Live | None]:
    """Yields a live display on the terminal; None without a terminal, or if nothing is to be `shown`."""
    console = plain_console(soft_wrap=False)
    if not (shown and console.is_terminal):
        yield None
        return
    with Live(console=console, auto_refresh=False, transient=transient) as live:
        yield live


def draw(live: Live, picture: Callable[..., RenderableType]) -> None:
    """Draw a picture of `width` and `height`. The last line stays free, because the cursor would scroll it."""
    live.update(picture(width=live.console.width, height=live.console.height - 1), refresh=True)


Ended = Callable[[int], None]
"""A callback for the end of each piece of work, called with the number of pieces left."""


@contextmanager
def progress(*, shown: bool) -> Generator[Callable[[str], Ended]]:
    """Yields a function that begins a named progress bar; without a terminal nothing is drawn.

    The number of pieces left may change on the way, as in a search.
    """
    from rich import progress as bars

    console = plain_console(stderr=True, soft_wrap=False)
    columns = (
        bars.TextColumn("{task.description}", markup=False),
        bars.BarColumn(),
        bars.MofNCompleteColumn(),
        bars.TimeElapsedColumn(),
        bars.TextColumn("left"),
        bars.TimeRemainingColumn(elapsed_when_finished=False),
    )
    drawn = shown and console.is_terminal
    with bars.Progress(*columns, console=console, disable=not drawn, transient=True) as bar:

        def begin(name: str) -> Ended:
            task, done = bar.add_task(name, total=None), 0

            def ended(left: int) -> None:
                nonlocal done
                done += 1
                bar.update(task, completed=done, total=done + left)

            return ended

        yield begin


def vehicles_text(system_ids: Sequence[int]) -> str:
    """Vehicles by their system ids, of which at most the first `_MOST_NAMED` are named."""
    named = " ".join(str(system_id) for system_id in system_ids[:_MOST_NAMED])
    more = f" and {len(system_ids) - _MOST_NAMED} more" if len(system_ids) > _MOST_NAMED else ""
    return f"vehicle{'s' * (len(system_ids) > 1)} {named}{more}"
