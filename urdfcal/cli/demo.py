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
    from urdfcal.robot.chain import Chain
    from urdfcal.session.files import read_rig, read_session
    from urdfcal.session.rigs import find_rig
    from urdfcal.session.simulate import simulate, write_simulated

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

    chain = calibration.chain
    truth = Chain.from_urdf(folder / "session" / "truth.urdf", chain.tip_link, chain.base_link)
    built = Chain.from_urdf(folder / "result" / calibration.urdf_name, chain.tip_link, chain.base_link)
    q = chain.random_values(1000, np.random.default_rng(seed))
    before, after = (asdict(Spread.of(1e3 * compare(robot, truth, q).position)) for robot in (chain, built))
    click.echo(
        f"tip against the true robot over the workspace: {before['rms']:.2f} -> {after['rms']:.2f} mm rms, "
        f"{before['max']:.2f} -> {after['max']:.2f} mm max"
    )


def _candidates() -> map[Path]:
    return map(Path, (f"urdfcal-demo{'' if i == 1 else f'-{i}'}" for i in count(1)))
