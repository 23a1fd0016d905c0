"""``urdfcal compensate``: joint commands for a controller that keeps its nominal kinematics."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from urdfcal.errors import OutputError

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.output.trajectory import Trajectory
    from urdfcal.robot.compensation import Compensation

_BLOCK = 4096  # poses between two steps of the progress bar


@click.command("compensate")
@click.argument("result", type=click.Path(path_type=Path), metavar="OUT")
@click.argument("trajectory", type=click.Path(path_type=Path), metavar="TRAJECTORY.csv")
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="CSV file to write.")
def command(result: Path, trajectory: Path, output: Path) -> None:
    """Correct the joint commands of TRAJECTORY.csv so that the real tip goes where the nominal one would.

    OUT is a folder that calibrate has written, or its calibration.json. Columns are joint names, in rad and m; others,
    such as time, are kept.
    """
    from urdfcal import files
    from urdfcal.cli.console import progress_bar
    from urdfcal.output.trajectory import Trajectory
    from urdfcal.result import Calibration
    from urdfcal.robot.kinematics import tip_poses

    calibration = Calibration.load(result)
    given = Trajectory.read(trajectory, calibration.chain)
    if output.exists() and output.samefile(trajectory):
        raise OutputError(
            "this is the trajectory itself", where=str(output), remedy="Name another file: nothing is corrected twice."
        )
    parts = []
    with progress_bar("compensating", len(given.q)) as advance:
        for first in range(0, len(given.q), _BLOCK):
            parts.append(calibration.compensate(given.q[first : first + _BLOCK]))
            advance(len(parts[-1].q))
    found = _joined(parts)
    files.write_text(output, given.with_commands(found.q))
    values = calibration.chain.joint_values(given.q)
    error = tip_poses(calibration.calibrated, values) - tip_poses(calibration.chain, values)
    _print(output, given, found, error[:, :3, 3])


def _joined(parts: list[Compensation]) -> Compensation:
    import numpy as np

    from urdfcal.robot.compensation import Compensation

    return Compensation(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("q", "position", "angle")))


def _print(path: Path, given: Trajectory, found: Compensation, before: Floats) -> None:
    """What the commands leave, and where most: beside a singularity, at a limit, or of too few joints."""
    import numpy as np

    distance = np.linalg.norm(before, axis=1)
    worst, most_turned = int(np.argmax(found.position)), int(np.argmax(found.angle))
    click.echo(
        f"{path}: {len(given.q)} poses\n"
        f"tip against the nominal one, by the calibrated model: {1e3 * _rms(distance):.3g} mm rms as given, "
        f"{1e3 * _rms(found.position):.3g} mm compensated\n"
        f"worst residual: {1e3 * found.position[worst]:.3g} mm (line {given.line(worst)}), "
        f"{1e3 * found.angle[most_turned]:.3g} mrad (line {given.line(most_turned)})"
    )


def _rms(values: Floats) -> float:
    import numpy as np

    return float(np.sqrt(np.mean(values**2)))
