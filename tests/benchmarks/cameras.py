"""Calibration with cameras that were calibrated themselves: the whole way from pictures, with the command line.

    python -m tests.benchmarks.cameras [--seeds 6] [--views 24] [--poses 50]

For every seed: pictures of a board before the ur5 rig's true cameras, `urdfcal cameras`; pictures of the LED on a
simulated arm, `urdfcal detect` and calibration with the cameras so found. Printed is the tip's rms error over the
workspace, after base alignment, in mm:

- known: from ideal centroids of the detected sigmas, with the true cameras;
- images: from the pictures, with the true cameras;
- fixed, refine, auto: from the pictures, with the cameras from the boards, under `estimate: {intrinsics, extrinsics}`;
- sigma: the largest error of the refined lenses in their own standard deviations;

and over all seeds each one's rms, over that of the known cameras.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tests.cameras.board.boards import CHARUCO, held
from tests.cameras.board.rendering import BoardRenderer
from urdfcal.cli.calibrate import find_leds as detect
from urdfcal.cli.cameras import command as cameras_command
from urdfcal.estimation.blocks.cameras import lens_key
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.measurements import Detections
from urdfcal.images.files import in_parallel, write_image
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate
from urdfcal.simulation.images import TRUTH, Exposure, write_simulated_images
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from urdfcal.cameras.rig import Rig
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated

BOARD = ("--board", "charuco", "10x7", "--square", "0.03", "--marker", "0.022", "--dictionary", "DICT_5X5_100")


def photograph_boards(folder: Path, truth: Rig, views: int, seed: int) -> None:
    """Write folder/<camera>/<view>.png."""
    poses = held(truth, CHARUCO, views, np.random.default_rng(seed), far=0.75)
    renderers = [BoardRenderer(camera) for camera in truth.cameras]

    def take(item: tuple[int, int]) -> None:
        c, v = item
        rng = np.random.default_rng([seed, c, v])
        image = renderers[c].render(CHARUCO, truth.T_cam_world[c] @ poses[v], blur=0.8, noise=2.0, rng=rng)
        write_image(folder / truth.names[c] / f"{v:02d}.png", image)

    for name in truth.names:
        (folder / name).mkdir(parents=True)
    list(in_parallel(take, np.ndindex(len(truth.cameras), views)))


def ideal(session: Session, simulated: Simulated, folder: Path, seed: int) -> Session:
    """The session with the true places of its sightings, and noise of the sigmas that were claimed."""
    with (folder / TRUTH).open() as file:
        truth = {(row["pose"], row["camera"]): (float(row["u"]), float(row["v"])) for row in csv.DictReader(file)}
    seen = session.find(Detections)
    places = [truth[session.poses[p], session.rig.names[c]] for p, c in zip(seen.pose, seen.camera, strict=True)]
    noise = seen.sigma[:, None] * np.random.default_rng([seed, 1]).standard_normal(seen.uv.shape)
    return replace(session, rig=simulated.session.rig, measurements=(replace(seen, uv=np.array(places) + noise),))


def tip_error(calibration: FittedCalibration, simulated: Simulated, seed: int) -> float:
    q = calibration.chain.random_values(500, np.random.default_rng(seed))
    arms = (replace(calibration.chain, placements=M) for M in (calibration.placements, simulated.truth.placements))
    return 1e3 * float(np.sqrt(np.mean(compare(*arms, q).position ** 2)))


def lens_error(calibration: FittedCalibration, truth: Rig) -> float:
    """The largest error of a lens' parameter in its standard deviations."""
    fit = calibration.fit
    sigma = fit.parameters.sigmas(fit.covariance)
    errors = [
        (fit.state[key].parameters - camera.parameters) / sigma[fit.parameters.columns(key)]
        for camera in truth.cameras
        if fit.parameters.has_active(key := lens_key(camera.name))
    ]
    return float(np.nanmax(np.abs(np.concatenate(errors))))


def run(folder: Path, seed: int, views: int, poses: int) -> dict[str, float]:
    simulated = simulate(read_rig(find_rig("ur5")), poses=poses, seed=seed)
    truth = simulated.session.rig
    photograph_boards(folder / "boards", truth, views, seed)
    session = folder / "session"
    write_simulated_images(session, simulated, Exposure())
    with redirect_stdout(StringIO()):
        arguments = [str(folder / "boards"), "-o", str(session / "cameras.yaml"), *BOARD]
        cameras_command.main(arguments, standalone_mode=False)
        detect(session)
    measured = read_session(session)

    def error(session: Session, intrinsics: str | None, extrinsics: str | None) -> float:
        calibration = calibrate(replace(session, estimate=Estimate("dh", intrinsics, extrinsics)), force=True)
        return tip_error(calibration, simulated, seed)

    refined = calibrate(replace(measured, estimate=Estimate("dh", "refine", "refine")))
    return {
        "known": error(ideal(measured, simulated, session, seed), "fixed", "fixed"),
        "images": error(replace(measured, rig=truth), "fixed", "fixed"),
        "fixed": error(measured, "fixed", "fixed"),
        "refine": tip_error(refined, simulated, seed),
        "auto": error(measured, None, None),
        "sigma": lens_error(refined, truth),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--poses", type=int, default=50)
    arguments = parser.parse_args()
    rows = []
    for seed in range(arguments.seeds):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(run(Path(folder), seed, arguments.views, arguments.poses))
        if not seed:
            print("seed " + "".join(f"{name:>10}" for name in rows[0]))
        print(f"{seed:4} " + "".join(f"{value:10.4f}" for value in rows[-1].values()), flush=True)
    rms = {name: np.sqrt(np.mean([row[name] ** 2 for row in rows])) for name in rows[0] if name != "sigma"}
    print("rms  " + "".join(f"{value:10.4f}" for value in rms.values()))
    print("over " + "".join(f"{value / rms['known']:10.3f}" for value in rms.values()))


if __name__ == "__main__":
    main()
