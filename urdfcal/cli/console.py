"""Tables on the terminal, and progress that is shown only on a terminal."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.console import Console
    from rich.table import Table

# Wide enough for a DH table with its joint names; a pipe has no width of its own.
_PIPE_WIDTH = 110


def output() -> Console:
    """Standard output: as wide as the terminal, or as a table needs where it is piped."""
    from rich.console import Console

    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=_PIPE_WIDTH)


def sheet(title: str, columns: list[str], texts: int = 1) -> Table:
    """A table whose first ``texts`` columns are words and the others numbers."""
    from rich import box
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i < texts else "right", no_wrap=i < texts)
    return table


@contextmanager
def progress_bar(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show a bar (a spinner where ``total`` is None) on standard error; yield what advances it."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)
        yield lambda count: bar.advance(task, count)


@contextmanager
def status_line(*, show: bool = True) -> Iterator[Callable[[str], None]]:
    """Show a spinner with a changing text on standard error, if it is a terminal; yield what changes it."""
    from rich.console import Console

    console = Console(stderr=True)
    if not show or not console.is_terminal:
        yield lambda _: None
        return
    with console.status("reading") as status:
        yield lambda text: status.update(text)
