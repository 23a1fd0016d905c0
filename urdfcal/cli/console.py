"""What commands share: options, tables on the terminal, and progress that is shown only on a terminal."""

from __future__ import annotations

import os
import shutil
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from urdfcal.typography import lines_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.console import Console
    from rich.table import Table

PATH = click.Path(path_type=Path)
POSITIVE = click.FloatRange(min=0.0, min_open=True)

result_argument = click.argument("result", type=PATH, metavar="OUT")
base_option = click.option("--base", metavar="LINK", help="Link at its start.  [default: the root link]")
seed_option = click.option("--seed", type=click.IntRange(min=0), default=0, help="Seed of all random numbers.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")

# Wide enough for a DH table with its joint names; a pipe has no width of its own.
_PIPE_WIDTH = 110
# What is narrower cuts digits: a pipe can be wider.
_LEAST_WIDTH = 72
INDENT = "  "
"""Of a line that continues the one above."""


def terminal() -> Console:
    """Standard output: as wide as the terminal or $COLUMNS, or as a table needs where it is piped."""
    from rich.console import Console

    console = Console(highlight=False)
    columns = os.environ.get("COLUMNS", "")
    told = columns.isdecimal() and int(columns) >= _LEAST_WIDTH
    return console if console.is_terminal or told else Console(highlight=False, width=_PIPE_WIDTH)


def say(text: str, *, err: bool = False) -> None:
    """Print sentences: on a terminal no wider than it, continued on the next line; piped as long as they are."""
    stream = sys.stderr if err else sys.stdout
    # As rich sees it.
    if os.environ.get("FORCE_COLOR") or stream.isatty():
        width = shutil.get_terminal_size().columns
        text = "\n".join(row for line in text.splitlines() for row in lines_of(line, width, INDENT))
    click.echo(text, err=err)


def sheet(title: str, columns: list[str], texts: int = 1, *, fold: bool = False) -> Table:
    """A table whose first ``texts`` columns are words and the others numbers.

    Where it is wider than the terminal heads of numbers are broken, or, with ``fold``, words: for heads that are short.
    """
    from rich import box
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        word = i < texts
        table.add_column(column, justify="left" if word else "right", no_wrap=word != fold, overflow="fold")
    return table


@contextmanager
def progress_bar(what: str, total: int | None) -> Iterator[Callable[[float], None]]:
    """Show a bar (a spinner where ``total`` is None) on standard error; yield what advances it."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)
        yield lambda count: bar.advance(task, count)
        # Some was not needed, or not counted: it is done all the same.
        bar.update(task, total=total or 1, completed=total or 1)


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
