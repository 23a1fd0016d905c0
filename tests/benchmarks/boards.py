"""Cameras calibrated from rendered board images, against the truth.

python -m tests.benchmarks.boards [SEEDS] [chessboard|charuco]
"""

from __future__ import annotations

import sys

import numpy as np

from tests.cameras.board.boards import CHARUCO, CHESSBOARD, as_views, errors, held
from tests.cameras.board.rendering import BoardRenderer
from urdfcal.cameras.board.calibration import calibrate_cameras
from urdfcal.cameras.board.detection import detect_board
from urdfcal.cameras.io.formats import read_kalibr
from urdfcal.images.files import in_parallel
from urdfcal.io.shipped_rigs import find_rig


def main(seeds: int, kind: str) -> None:
    """Print, for the UR5 rig's pair of cameras, how far off each seed's parameters are in standard deviations."""
    board = CHESSBOARD if kind == "chessboard" else CHARUCO
    truth = read_kalibr(find_rig("ur5") / "cameras.yaml")
    renderers = [BoardRenderer(camera) for camera in truth.cameras]
    deviations, chi2 = [], []
    for seed in range(seeds):
        poses = held(truth, board, 24, np.random.default_rng(seed), far=0.75)

        def corners(item: tuple[int, int], poses: list[np.ndarray] = poses, seed: int = seed) -> np.ndarray:
            c, v = item
            rng = np.random.default_rng([seed, c, v])
            image = renderers[c].render(board, truth.T_cam_world[c] @ poses[v], blur=0.8, noise=2.0, rng=rng)
            found = detect_board(image, board)
            return np.full((len(board.corners), 2), np.nan) if found is None else found.uv

        uv = np.reshape(list(in_parallel(corners, np.ndindex(2, 24))), (2, 24, -1, 2))
        found = calibrate_cameras(as_views(truth, uv), board)
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
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10, sys.argv[2] if len(sys.argv) > 2 else "charuco")
