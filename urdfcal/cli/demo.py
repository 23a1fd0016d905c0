"""``urdfcal demo``: the main job on a shipped rig, from nothing to a corrected URDF."""

from __future__ import annotations

from itertools import count
from pathlib import Path

import click

from urdfcal.cli.options import seed_option


@click.command("demo")
@click.argument("rig", default="ur5")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Folder to make.  [default: urdfcal-demo, or -2, -3, ...]"
)
@seed_option
def command(rig: str, output: Path | None, seed: int) -> None:
    """Simulate a session of RIG, calibrate it, and compare the result with the truth."""
    from dataclasses import asdict

    import numpy as np

    from urdfcal.cli.calibrate import run
    from urdfcal.errors import OutputError
    from urdfcal.estimation.evaluation import Spread, compare
    from urdfcal.io.folder import read_rig, read_session
    from urdfcal.io.shipped_rigs import find_rig
    from urdfcal.robot.chain import Chain
    from urdfcal.robot.mechanism import BASE
    from urdfcal.robot.urdf.urdf import find_urdf
    from urdfcal.simulation.simulate import simulate, write_simulated

    description = read_rig(find_rig(rig))
    folder = output or next(path for path in _candidates() if not path.exists())
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise OutputError(
            f"cannot make this folder: {error.strerror}", where=str(folder), remedy="Name a new one with -o."
        ) from error
    write_simulated(folder / "session", simulate(description, poses=50, seed=seed))
    calibration = run(read_session(folder / "session"), folder / "result", seed)

    session = calibration.session
    urdfs = (
        find_urdf(session.urdf_reference, relative_to=session.folder),
        folder / "result" / calibration.urdf_name,
        folder / "session" / "truth.urdf",
    )
    tips = [tip.link for tip in session.chain.tips if tip.joint != BASE]
    for link in tips:
        nominal, calibrated, truth = (Chain.from_urdf(urdf, link, session.chain.base_link) for urdf in urdfs)
        q = nominal.random_values(1000, np.random.default_rng(seed))
        before, after = (asdict(Spread.of(1e3 * compare(robot, truth, q).position)) for robot in (nominal, calibrated))
        click.echo(
            f"{'tip' if len(tips) == 1 else link} against the true robot over the workspace: "
            f"{before['rms']:.2f} -> {after['rms']:.2f} mm rms, {before['max']:.2f} -> {after['max']:.2f} mm max"
        )


def _candidates() -> map[Path]:
    return map(Path, (f"urdfcal-demo{'' if i == 1 else f'-{i}'}" for i in count(1)))
