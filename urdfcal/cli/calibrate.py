"""``urdfcal calibrate``: a session in, a corrected URDF out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from urdfcal.cli.options import seed_option

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from urdfcal.calibration import Calibration
    from urdfcal.session.model import Session


@click.command("calibrate")
@click.argument("session", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="Folder of the results.")
@seed_option
def command(session: Path, output: Path, seed: int) -> None:
    """Calibrate the robot of SESSION and write URDF, calibration.json and recording."""
    from urdfcal.session.files import read_session

    run(read_session(session), output, seed)


def run(session: Session, output: Path, seed: int) -> Calibration:
    """Calibrate a session, write its results and print the summary."""
    from urdfcal.calibration import calibrate
    from urdfcal.cli.console import progress_bar
    from urdfcal.output.results import write_results

    with progress_bar("calibrating", None) as advance:
        calibration = calibrate(session, seed=seed, progress=lambda *_: advance(1))
        paths, notes = write_results(calibration, output)
    _print(calibration, paths, notes)
    return calibration


def _print(calibration: Calibration, paths: Iterable[Path], notes: Sequence[str]) -> None:
    import numpy as np

    from urdfcal.cli.console import output, sheet
    from urdfcal.robot.dh import PARAMETERS

    console = output()
    fit = calibration.summary()
    console.print(
        f"{calibration.chain.name}: {fit['poses']} poses, {fit['observations']} measured numbers, "
        f"{fit['parameters']} parameters, {len(calibration.outliers())} outliers"
    )
    for unit in ("px", "mm"):
        if f"rms_{unit}" in fit:
            before, after = fit[f"rms_nominal_{unit}"], fit[f"rms_{unit}"]
            console.print(f"residual {before:.3f} -> [bold]{after:.3f} {unit}[/] rms, nominal -> calibrated")

    units = {name: "mm" if name in "da" else "mrad" for name in PARAMETERS}
    rows = sheet("offsets ± standard deviation", ["joint", *(f"{name} ({unit})" for name, unit in units.items())])
    for row, offsets, sigmas in zip(
        calibration.table.rows, 1e3 * calibration.estimate.offsets, 1e3 * calibration.sigmas(), strict=True
    ):
        cells = [f"{o:.3f} ± {s:.3f}" if np.isfinite(s) else "" for o, s in zip(offsets, sigmas, strict=True)]
        rows.add_row(row.joint, *cells)
    console.print(rows)
    for text in (*(f"not told: {lost}" for lost in calibration.identifiability.lost), *calibration.warnings, *notes):
        console.print(f"- {text}", markup=False)
    for path in paths:
        console.print(str(path), markup=False)
