"""A pair of cameras, boards held before them, and the corners they see."""

from __future__ import annotations

import numpy as np

from urdfcal.cameras.board.board import Board
from urdfcal.cameras.board.views import BoardViews
from urdfcal.cameras.camera import Camera
from urdfcal.cameras.rig import Rig

SIZE = (640, 512)
CHESSBOARD = Board("chessboard", 9, 6, 0.03)
CHARUCO = Board("charuco", 10, 7, 0.03, 0.022, "DICT_5X5_100")


def turned(vector: list[float] | np.ndarray) -> np.ndarray:
    """The rotation about a vector by its length."""
    x, y, z = np.asarray(vector, dtype=float)
    W = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.hypot(np.hypot(x, y), z))
    return np.eye(3) + np.sinc(angle / np.pi) * W + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * W @ W


def placed(vector: list[float], t: list[float]) -> np.ndarray:
    """The transform of a rotation vector and a translation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turned(vector), t
    return T


PAIR = Rig(
    (
        Camera("left", SIZE, [702.3, 701.1, 321.4, 252.8], "radtan", [-0.11, 0.09, 4e-4, -3e-4]),
        Camera("right", SIZE, [698.8, 699.9, 316.2, 258.9], "radtan", [-0.10, 0.08, -2e-4, 5e-4]),
    ),
    (np.eye(4), placed([0.01, 0.33, 0.005], [-0.25, 0.002, 0.03])),
)


def held(
    rig: Rig, board: Board, count: int, rng: np.random.Generator, tilt: float = 0.6, far: float = 0.9
) -> list[np.ndarray]:
    """Poses T_world_board with the board's middle in the first camera's view."""
    camera = rig.cameras[0]
    w, h = camera.resolution
    poses = []
    for _ in range(count):
        R = turned(rng.uniform(-tilt, tilt, 3))
        distance = rng.uniform(0.4, far) * camera.intrinsics[0] / 700.0
        T = np.eye(4)
        T[:3, :3] = R
        middle = camera.unproject(rng.uniform([0.3 * w, 0.3 * h], [0.7 * w, 0.7 * h]))
        T[:3, 3] = distance * middle - R @ board.corners.mean(0)
        poses.append(T)
    return poses


def true_corners(rig: Rig, board: Board, T_world_board: np.ndarray) -> np.ndarray:
    """(C, N, 2) px; NaN all over for a camera that does not have the whole board in its image."""
    points = board.corners @ T_world_board[:3, :3].T + T_world_board[:3, 3]
    seen = []
    for camera, T in zip(rig.cameras, rig.T_cam_world, strict=True):
        uv = camera.project(points @ T[:3, :3].T + T[:3, 3])
        seen.append(np.where(camera.in_image(uv, 10).all(), uv, np.nan))
    return np.array(seen)


def as_views(rig: Rig, uv: np.ndarray) -> BoardViews:
    """Corners (C, V, N, 2) as if read from images, which claim nothing of how well."""
    covariance = np.zeros((*uv.shape, 2))
    names = tuple(f"{i:02d}" for i in range(uv.shape[1]))
    return BoardViews(rig.names, tuple(c.resolution for c in rig.cameras), names, uv, covariance, ())


def seen(rig: Rig, board: Board, count: int, seed: int, sigma: float = 0.02, tilt: float = 0.6) -> BoardViews:
    """What the cameras see of boards held at random, each corner with Gaussian noise."""
    rng = np.random.default_rng(seed)
    uv = np.stack([true_corners(rig, board, T) for T in held(rig, board, count, rng, tilt)], axis=1)
    return as_views(rig, uv + rng.normal(0.0, sigma, uv.shape))


def errors(rig: Rig, truth: Rig) -> np.ndarray:
    """Of all parameters as a calibration has them: each camera's lens, then its place, a motion after T_cam_world."""
    parts = []
    for i, (got, expected) in enumerate(zip(rig.cameras, truth.cameras, strict=True)):
        parts.append(got.parameters - expected.parameters)
        if i > 0:
            D = rig.T_cam_world[i] @ np.linalg.inv(truth.T_cam_world[i])
            parts += [D[:3, 3], 0.5 * np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])]
    return np.concatenate(parts)
