"""Cameras calibrated from board images: rendered ones against the truth, real ones against OpenCV.

    python -m tests.benchmarks.boards [SEEDS] [chessboard|charuco]
    python -m tests.benchmarks.boards real

`real` takes the pairs of the Debian package opencv-doc, as they are and spoilt, through the command line. Printed are
the pictures used, the reprojection error over OpenCV's (of each camera and of the pair, both coordinates together, from
its own corners on the pictures as they are), the worst standard deviation of f and c over that from the pictures as
they are, and how far f and c are from those, in standard deviations. Last, how far halves of the pictures as they are
disagree, in standard deviations of f and c: 1 if these are true.
"""

from __future__ import annotations

import re
import sys
import tempfile
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tests.cameras.board import real
from tests.cameras.board.boards import CHARUCO, CHESSBOARD, as_views, errors, held
from tests.cameras.board.rendering import BoardRenderer
from urdfcal.cameras.board.board import Board
from urdfcal.cameras.board.calibration import calibrate_cameras
from urdfcal.cameras.board.detection import detect_board
from urdfcal.cameras.board.views import read_views
from urdfcal.cameras.io.formats import read_kalibr
from urdfcal.cli.cameras import command
from urdfcal.errors import CameraError
from urdfcal.images.files import in_parallel
from urdfcal.io.shipped_rigs import find_rig

if TYPE_CHECKING:
    from urdfcal.cameras.board.corners import Corners
    from urdfcal.cameras.rig import Rig

COPIES = ("", "soft", "dim", "jpeg", "small", "soft+dim", "dim+jpeg", "soft+dim+jpeg", "small+dim+jpeg")
COPIES += ("small+soft", "small+soft+dim+jpeg")


def through_the_command_line(folder: Path, how: str) -> tuple[Rig, list[tuple[int, float]]]:
    """The cameras, and of each the number of pictures used and the residual of a coordinate, px."""
    real.write(folder / "pictures", how)
    with redirect_stdout(text := StringIO()):
        arguments = [str(folder / "pictures"), "-o", str(folder / "cameras.yaml"), *real.BOARD]
        command.main(arguments, standalone_mode=False)
    rows = [re.search(rf"^ {side} +(\d+) +\d+ +([\d.]+) ", text.getvalue(), re.MULTILINE) for side in real.SIDES]
    return read_kalibr(folder / "cameras.yaml"), [(int(row[1]), float(row[2])) for row in rows if row]


def pinholes(rig: Rig, size: float) -> tuple[np.ndarray, np.ndarray]:
    """(2, 4) f and c of both cameras as at full size, and their standard deviations."""
    values = np.array([camera.intrinsics for camera in rig.cameras]) / size
    values[:, 2:] += 0.5 * (1.0 / size - 1.0)
    return values, np.array([sigma.parameters[:4] for sigma in rig.sigmas if sigma]) / size


def against_opencv() -> None:
    errors = real.opencv()
    print("OpenCV: " + ", ".join(f"{name} {error:.3f} px" for name, error in errors.items()))
    print(f"{'copy':22}{'used':>8}{'left':>8}{'right':>8}{'pair':>8}{'sigma x':>9}{'apart':>8}")
    clean = None
    for how in COPIES:
        size = 0.5 if "small" in how else 1.0
        with tempfile.TemporaryDirectory() as folder:
            try:
                rig, seen = through_the_command_line(Path(folder), how)
            except CameraError as error:
                print(f"{how or 'as they are':22} refused: {error}")
                continue
        values, sigma = pinholes(rig, size)
        clean = clean or (values, sigma)
        ratios = [
            np.sqrt(2.0) * residual / size / errors[side] for side, (_, residual) in zip(real.SIDES, seen, strict=True)
        ]
        pair = np.sqrt(np.mean([2.0 * residual**2 for _, residual in seen])) / size / errors["pair"]
        used = "+".join(str(count) for count, _ in seen)
        apart = np.abs(values - clean[0]) / np.hypot(sigma, clean[1])
        row = "".join(f"{ratio:8.2f}" for ratio in (*ratios, pair))
        print(f"{how or 'as they are':22}{used:>8}{row}{(sigma / clean[1]).max():9.2f}{apart.max():8.1f}", flush=True)
    print(f"halves: rms {halves():.2f} sigma")


def halves(draws: int = 6) -> float:
    """How far cameras from one half of the pictures are from those of the other, rms in standard deviations."""
    with tempfile.TemporaryDirectory() as folder:
        real.write(Path(folder) / "pictures", "")
        views = read_views(Path(folder) / "pictures", Board("chessboard", 9, 6, 0.025))
    deviations, rng = [], np.random.default_rng(0)
    for _ in range(draws):
        order, found = rng.permutation(len(views.views)), []
        for half in np.array_split(order, 2):
            uv = np.full_like(views.uv, np.nan)
            uv[:, half] = views.uv[:, half]
            found.append(calibrate_cameras(replace(views, uv=uv), Board("chessboard", 9, 6, 0.025)).rig)
        (a, sigma_a), (b, sigma_b) = (pinholes(rig, 1.0) for rig in found)
        deviations.append((a - b) / np.hypot(sigma_a, sigma_b))
    return float(np.sqrt(np.mean(np.square(deviations))))


def main(seeds: int, kind: str) -> None:
    """Print, for the UR5 rig's pair of cameras, how far off each seed's parameters are in standard deviations."""
    board = CHESSBOARD if kind == "chessboard" else CHARUCO
    truth = read_kalibr(find_rig("ur5") / "cameras.yaml")
    renderers = [BoardRenderer(camera) for camera in truth.cameras]
    deviations, chi2 = [], []
    for seed in range(seeds):
        poses = held(truth, board, 24, np.random.default_rng(seed), far=0.75)

        def corners(item: tuple[int, int], poses: list[np.ndarray] = poses, seed: int = seed) -> Corners | None:
            c, v = item
            rng = np.random.default_rng([seed, c, v])
            image = renderers[c].render(board, truth.T_cam_world[c] @ poses[v], blur=0.8, noise=2.0, rng=rng)
            return detect_board(image, board)

        views = as_views(truth, np.full((2, 24, len(board.corners), 2), np.nan))
        for at, one in zip(np.ndindex(2, 24), in_parallel(corners, np.ndindex(2, 24)), strict=True):
            if one is not None:
                views.uv[at], views.covariance[at] = one.uv, one.covariance
        found = calibrate_cameras(views, board)
        if any(len(camera.distortion) != 4 for camera in found.rig.cameras):
            print(f"seed {seed}: k3 taken for real")
            continue
        error = errors(found.rig, truth)
        deviations.append(error / np.sqrt(np.diag(found.covariance)))
        chi2.append(error @ np.linalg.solve(found.covariance, error))
        noise = ", ".join(f"{q.sigma:.4f}" for q in found.qualities)
        print(f"seed {seed}: corners {noise} px, largest {np.abs(deviations[-1]).max():.2f} sigma, chi2 {chi2[-1]:.1f}")
    z = np.array(deviations)
    print(
        f"{len(z)} calibrations of {z.shape[1]} parameters: {np.mean(np.abs(z) > 3.0):.2%} beyond 3 sigma, "
        f"rms {np.sqrt(np.mean(z**2)):.2f} sigma, chi2 {np.mean(chi2):.1f} ± {np.sqrt(2 * z.shape[1] / len(z)):.1f}"
    )


if __name__ == "__main__":
    if sys.argv[1:] == ["real"]:
        against_opencv()
        sys.exit()
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10, sys.argv[2] if len(sys.argv) > 2 else "charuco")
