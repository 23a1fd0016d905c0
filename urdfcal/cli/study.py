"""``urdfcal study``: what a rig would bring, before anything is bought."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from urdfcal.cli.console import PATH, json_option, progress_bar, say, seed_option, sheet, terminal
from urdfcal.cli.engines import engine_options

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from urdfcal.study.engine import Engine
    from urdfcal.study.monte_carlo import Outcome


class Numbers(click.ParamType[tuple[float, ...]]):
    """Numbers with commas between, as 10,20,50."""

    name = "numbers"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Return them."""
        try:
            return tuple(float(number) for number in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not numbers with commas between, as 10,20,50", param, ctx)


_NUMBERS = Numbers()


@click.command("study")
@click.argument("rig", metavar="RIG")
@click.option("-o", "--output", type=PATH, help="Folder for table (study.csv), page (study.html) and recording.")
@click.option("--poses", type=_NUMBERS, help="Numbers of poses.")
@click.option("--pixel", type=_NUMBERS, help="Noise of the detections, px.")
@click.option("--baseline", type=_NUMBERS, help="Factors on how far cameras stand from the first one.")
@click.option("--lens", type=_NUMBERS, help="Factors on focal lengths.")
@click.option("--cameras", type=_NUMBERS, help="Numbers of cameras: the rig's first ones.")
@click.option("--leds", type=_NUMBERS, help="Numbers of LEDs; others than the rig's are put around its first.")
@click.option("--arm", type=_NUMBERS, help="Factors on how far arms are off their drawing.")
@click.option("--seeds", type=click.IntRange(min=1), default=20, help="Arms to simulate for each setting.")
@seed_option
@engine_options
@json_option
def command(
    rig: str, output: Path | None, seeds: int, seed: int, processes: int | None, engine: Engine, scheduler: str | None,
    as_json: bool, **varied: Any,
) -> None:  # fmt: skip
    """Simulate what RIG (a shipped rig's name or a folder) would bring, and with other poses, cameras or LEDs.

    One thing is varied at a time, the others as they are; the same arms are simulated for all, in 50 poses each where
    nothing else is said. What is expected follows from the measurements' noise and the tolerances alone (the bound of
    Cramer and Rao, with priors).
    """
    from urdfcal.files import check_place
    from urdfcal.io.folder import read_rig
    from urdfcal.io.shipped_rigs import find_rig
    from urdfcal.study.monte_carlo import settings_of, study
    from urdfcal.study.results import write_study

    where, settings = find_rig(rig), settings_of({name: values for name, values in varied.items() if values})  # type: ignore[misc]
    if output is not None:
        check_place(output)
    with progress_bar("simulating", seeds * len(settings)) as advance:
        table = study(
            where, settings, seeds=seeds, seed=seed, engine=engine, processes=processes, scheduler=scheduler,
            progress=advance,
        )  # fmt: skip
    if as_json:
        click.echo(json.dumps([{**asdict(one), "setting": str(one.setting)} for one in table], indent=2))
    else:
        _print(table)
    # Last: what took so long to find out is not lost where it cannot be written.
    paths = () if output is None else write_study(output, read_rig(where), table, seed)
    for path in () if as_json else paths:
        click.echo(path)


def _print(table: Sequence[Outcome]) -> None:
    from urdfcal.study.results import HEADS, failures, remarks, rows

    shown = sheet("", list(HEADS))
    for row in rows(table):
        shown.add_row(*row)
    terminal().print(shown)
    for text in remarks(table):
        say(f"- {text}")
    for why in failures(table):
        say(f"- {why}", err=True)
