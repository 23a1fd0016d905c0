"""``urdfcal batch``: the sessions of a fleet, calibrated at once."""

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

    from urdfcal.study.batch import Ended


@click.command("batch")
@click.argument("sessions", type=PATH, nargs=-1, required=True)
@click.option(
    "-o", "--output", type=PATH, required=True, help="Folder of the results, a folder in it for each session."
)
@click.option("--no-report", is_flag=True, help="Write URDF and calibration.json alone, which is several times faster.")
@click.option("--force", is_flag=True, help="Write results even if their assessment has failures.")
@click.option(
    "--method", type=click.Choice(["pixels", "points"]), default="pixels", help="As of `urdfcal calibrate`.",
)  # fmt: skip
@click.option("--no-priors", is_flag=True, help="As of `urdfcal calibrate`.")
@click.option("--starts", type=click.IntRange(min=0), default=0, metavar="N", help="As of `urdfcal calibrate`.")
@seed_option
@engine_options
@json_option
def command(
    sessions: tuple[Path, ...], output: Path, no_report: bool, no_priors: bool, scheduler: str | None, engine: str,
    as_json: bool, **how: Any,
) -> int:  # fmt: skip
    """Calibrate SESSIONS side by side.

    One that fails stops no other; run again, what is done is kept.

    Exit status 1 says that at least one session has no result that can be used.
    """
    from urdfcal.study.batch import TABLE, batch

    with progress_bar("calibrating", len(sessions)) as advance:
        table = batch(
            sessions, output, report=not no_report, priors=not no_priors, scheduler=scheduler, engine=engine,  # type: ignore[arg-type]
            progress=advance, **how,
        )  # fmt: skip
    if as_json:
        click.echo(json.dumps([asdict(one) for one in table], indent=2))
    else:
        _print(table)
        click.echo(str(output / TABLE))
    return int(not all(one.well for one in table))


def _print(table: Sequence[Ended]) -> None:
    rows = sheet("", ["session", "verdict", "nominal (mm)", "calibrated (mm)", "tip rms, at most (mm)", "s"], texts=2)
    for one in table:
        figures = (one.rms_nominal_mm, one.rms_mm, one.tip_rms_upper_mm, one.seconds)
        rows.add_row(one.name, one.level, *("" if figure is None else f"{figure:.3g}" for figure in figures))
    terminal().print(rows)
    for one in table:
        if one.level != "good":
            terminal().print(f"{one.name}: {one.sentence}", markup=False, highlight=False)
    counts = {level: sum(one.level == level for one in table) for level in ("good", "doubtful", "bad", "failed")}
    kept = sum(one.kept for one in table)
    before = f"; {kept} of them kept from an earlier run" if kept else ""
    say(f"{len(table)} sessions: " + ", ".join(f"{count} {level}" for level, count in counts.items() if count) + before)
