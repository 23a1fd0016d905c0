"""What runs many calibrations at once: the options that `batch` and `study` share."""

from __future__ import annotations

from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import click

if TYPE_CHECKING:
    from collections.abc import Callable

P = ParamSpec("P")
R = TypeVar("R")


def engine_options(command: Callable[P, R]) -> Callable[P, R]:
    """Give a command the options ``--processes``, ``--engine`` and ``--scheduler``."""

    @wraps(command)
    def checked(*args: P.args, **given: P.kwargs) -> R:
        if given["scheduler"] is not None and given["engine"] != "dask":
            raise click.UsageError("--scheduler goes with --engine dask")
        return command(*args, **given)

    options = (
        click.option(
            "--processes", type=click.IntRange(min=1), show_default=False, metavar="N",
            help="Processes on this machine.  [default: one for each core]",
        ),
        click.option(
            "--engine", type=click.Choice(["processes", "dask", "ray"]), default="processes",
            help="What runs them; a cluster's workers must see the same folders.",
        ),
        click.option("--scheduler", metavar="ADDRESS", help="Of Dask, tcp://host:8786.  [default: a local cluster]"),
    )  # fmt: skip
    for option in reversed(options):
        checked = option(checked)
    return checked
