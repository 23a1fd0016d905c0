"""``urdfcal study``: what a rig would bring, before anything is bought."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import click

from urdfcal.cli.console import json_option, progress_bar, say, seed_option, sheet, terminal


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
@click.option("--poses", type=_NUMBERS, help="Numbers of poses.")
@click.option("--pixel", type=_NUMBERS, help="Noise of the detections, px.")
@click.option("--baseline", type=_NUMBERS, help="Factors on how far cameras stand from the first one.")
@click.option("--lens", type=_NUMBERS, help="Factors on focal lengths.")
@click.option("--cameras", type=_NUMBERS, help="Numbers of cameras: the rig's first ones.")
@click.option("--leds", type=_NUMBERS, help="Numbers of LEDs; others than the rig's are put around its first.")
@click.option("--arm", type=_NUMBERS, help="Factors on how far arms are off their drawing.")
@click.option("--seeds", type=click.IntRange(min=1), default=20, help="Arms to simulate for each setting.")
@seed_option
@click.option(
    "--processes", type=click.IntRange(min=1), show_default=False, metavar="N",
    help="Processes on this machine.  [default: one for each core]",
)  # fmt: skip
@json_option
def command(rig: str, seeds: int, seed: int, processes: int | None, as_json: bool, **varied: Any) -> None:
    """Simulate what RIG (a shipped rig's name or a folder) would bring, and with other poses, cameras or LEDs.

    One thing is varied at a time, the others as they are; the same arms are simulated for all. What is
    expected follows from the measurements' noise and the tolerances alone (the bound of Cramer and Rao, with priors).
    """
    from urdfcal.io.shipped_rigs import find_rig
    from urdfcal.study.monte_carlo import settings_of, study

    settings = settings_of({name: values for name, values in varied.items() if values})  # type: ignore[misc]
    with progress_bar("simulating", seeds * len(settings)) as advance:
        table = study(find_rig(rig), settings, seeds=seeds, seed=seed, processes=processes, progress=advance)
    if as_json:
        click.echo(json.dumps([{**asdict(one), "setting": str(one.setting)} for one in table], indent=2))
        return
    rows = sheet("", ["setting", "tip (mm rms)", "1 in 10 above", "expected", "nominal", "arms"])
    for one in table:
        figures = (one.error, one.worst, one.expected, one.nominal)
        rows.add_row(
            str(one.setting), *(f"{1e3 * figure:.3g}" if one.count else "" for figure in figures), str(one.count)
        )
    terminal().print(rows)
    for one in table:
        for why in one.failed:
            say(f"- {one.setting}: {why}", err=True)
