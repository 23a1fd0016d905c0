"""``urdfcal compensate``: correct joint commands for a controller that keeps its nominal kinematics."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from urdfcal.errors import OutputError

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.output.trajectory import CommandTable
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.compensation import Compensation

_BLOCK = 4096  # poses between two steps of the progress bar


@click.command("compensate")
@click.argument("result", type=click.Path(path_type=Path), metavar="OUT")
@click.argument("trajectory", type=click.Path(path_type=Path), metavar="TRAJECTORY.csv")
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="CSV file to write.")
def command(result: Path, trajectory: Path, output: Path) -> None:
    """Correct the joint commands of TRAJECTORY.csv so that the real tip goes where the nominal one would.

    For a tree of joints this is the session's tip link; the errors of the other tip links are reported.

    OUT is a folder that calibrate has written, or its calibration.json. Columns are joint names, in rad and m; others,
    such as time, are kept.
    """
    from urdfcal import files
    from urdfcal.cli.console import progress_bar
    from urdfcal.output.trajectory import CommandTable
    from urdfcal.result.calibration import Calibration

    calibration = Calibration.load(result)
    given = CommandTable.read(trajectory, calibration.chain)
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
    before, after = (_errors(calibration, given.q, commands) for commands in (given.q, found.q))
    _print(output, given, found, next(iter(before.values())))
    for link in list(before)[1:]:
        click.echo(
            f"{link} is not compensated: {1e3 * before[link]:.3g} mm rms with the nominal commands, "
            f"{1e3 * after[link]:.3g} mm with the corrected ones"
        )


def _joined(parts: list[Compensation]) -> Compensation:
    import numpy as np

    from urdfcal.robot.compensation import Compensation

    return Compensation(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("q", "position", "angle")))


def _errors(calibration: Calibration, nominal_commands: Floats, commands: Floats) -> dict[str, float]:
    """Distances (rms, m) of the calibrated tip links with commands (N, k) from the nominal ones with theirs (N, k)."""
    from urdfcal.robot.kinematics import link_poses
    from urdfcal.robot.mechanism import BASE

    chain = calibration.chain
    tips = [chain.tips[0], *(tip for tip in chain.tips[1:] if tip.joint != BASE)]
    nominal = link_poses(chain, chain.joint_values(nominal_commands), tips)
    real = link_poses(calibration.calibrated, chain.joint_values(commands), tips)
    return {tip.link: _rms_length(T[:, :3, 3] - S[:, :3, 3]) for tip, T, S in zip(tips, real, nominal, strict=True)}


def _print(path: Path, given: CommandTable, found: Compensation, before: float) -> None:
    """Print the error that the commands leave, and the lines of the worst poses: singular, at a limit, out of reach."""
    import numpy as np

    worst, most_turned = int(np.argmax(found.position)), int(np.argmax(found.angle))
    click.echo(
        f"{path}: {len(given.q)} poses\n"
        f"distance of the calibrated tip from the nominal one: {1e3 * before:.3g} mm rms with the nominal commands, "
        f"{1e3 * _rms_length(found.position[:, None]):.3g} mm with the corrected ones\n"
        f"worst residual: {1e3 * found.position[worst]:.3g} mm (line {given.line(worst)}), "
        f"{1e3 * found.angle[most_turned]:.3g} mrad (line {given.line(most_turned)})"
    )


def _rms_length(vectors: Floats) -> float:
    import numpy as np

    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
