"""Where a bundle adjustment starts: focal lengths, board poses and camera places in closed form."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, Ints, inverse
from urdfcal.cameras.camera import Camera
from urdfcal.rotations import skew

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.cameras.board.board import Board

# Half fields of view from 80° (fisheye) to 4°: focal lengths as multiples of the image's longer side.
_FOCALS = np.geomspace(0.25, 8.0, 36)
# What else is tried: a barrel lens looks like a shorter one, a fisheye like a longer one.
_RATIOS = (1.0, 0.8, 1.25, 1.6, 0.6)
# Two places of a camera that differ by more (radians, and lengths against the board's distance) do not agree.
_AGREE = 0.2


def board_poses(camera: Camera, board: Board, uv: Floats) -> Floats:
    """T_cam_board (V, 4, 4) from the corners ``uv`` (V, N, 2) of V images by direct linear transformation.

    The corners of a plane are seen along d ~ H (x, y, 1), H = [r1 r2 t] up to scale; d x H (x, y, 1) = 0 is
    linear in H.
    """
    rays = camera.unproject(uv)
    seen = np.isfinite(rays[..., 0])
    d = np.where(seen[..., None], rays / np.linalg.norm(rays, axis=-1, keepdims=True), 0.0)
    scale = np.abs(board.corners).max()
    flat = np.column_stack([board.corners[:, :2] / scale, np.ones(len(board.corners))])
    A = np.einsum("vnij,nk->vnijk", skew(d), flat).reshape(len(uv), 3 * len(flat), 9)
    _, vectors = np.linalg.eigh(np.swapaxes(A, 1, 2) @ A)
    H = vectors[:, :, 0].reshape(-1, 3, 3) / np.array([scale, scale, 1.0])
    length = 0.5 * np.linalg.norm(H[:, :, :2], axis=1).sum(axis=1)
    # The board is in front: the sign of H is that of the rays.
    ahead = np.einsum("vni,vij,nj->v", d, H, np.column_stack([board.corners[:, :2], np.ones(len(flat))]))
    H /= (np.where(ahead < 0.0, -1.0, 1.0) * np.maximum(length, 1e-300))[:, None, None]
    M = np.stack([H[:, :, 0], H[:, :, 1], np.cross(H[:, :, 0], H[:, :, 1])], axis=2)
    U, _, Vt = np.linalg.svd(M)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    T = np.tile(np.eye(4), (len(uv), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = U @ Vt, H[:, :, 2]
    return T


def first_guesses(name: str, resolution: tuple[int, int], model: str, board: Board, uv: Floats) -> list[Camera]:
    """Cameras without distortion to start from, the likeliest first.

    Likeliest is the focal length for which the boards (V, N, 2) are most nearly flat and square; a lens that bends much
    leads it astray, so shorter and longer ones follow.
    """
    w, h = resolution
    coefficients = np.zeros(0 if model == "none" else 4)

    def camera(focal: float) -> Camera:
        intrinsics = np.array([focal, focal, 0.5 * (w - 1), 0.5 * (h - 1)])
        return Camera(name, resolution, intrinsics, model, coefficients)

    def misfit(focal: float) -> float:
        guess = camera(focal)
        error = guess.project(board.at(board_poses(guess, board, uv))) - uv
        squared = np.where(np.isfinite(uv), np.nan_to_num(error, nan=1e3) ** 2, 0.0).sum(axis=(1, 2))
        return float(np.median(squared / np.isfinite(uv[..., 0]).sum(axis=1)))

    best = min(_FOCALS * max(w, h), key=misfit)
    return [camera(ratio * best) for ratio in _RATIOS]


def place(cameras: Sequence[Camera], board: Board, uv: Floats) -> tuple[list[Floats | None], Floats, Ints]:
    """Where the cameras stand, from the boards that two or more of them saw.

    A board that looks the same from several sides may have been read differently by two cameras; only one reading lets
    the cameras stand still from view to view.

    Args:
        cameras: C first guesses.
        board: what they saw.
        uv: (C, V, N, 2) px, NaN where a corner was not seen.

    Returns:
        T_cam_world of each camera, None where no chain of common views leads to the first; T_world_board (V, 4, 4), NaN
        where no such camera saw it; and (C, V, N) the order of the corners in which the readings agree.
    """
    seen = np.asarray(np.isfinite(uv[..., 0]).any(axis=2))
    orders = np.broadcast_to(np.arange(uv.shape[2]), uv.shape[:3]).copy()
    T_cam_world: list[Floats | None] = [np.eye(4), *[None] * (len(cameras) - 1)]
    T_world_board = np.full((uv.shape[1], 4, 4), np.nan)
    T_world_board[seen[0]] = board_poses(cameras[0], board, uv[0, seen[0]])
    while True:
        known = np.isfinite(T_world_board[:, 0, 0])
        common = [0 if T is not None else int((seen[c] & known).sum()) for c, T in enumerate(T_cam_world)]
        c = int(np.argmax(common))
        if common[c] == 0:
            return T_cam_world, T_world_board, orders
        views = np.flatnonzero(seen[c] & known)
        # (S, views, 4, 4): this camera's place, for every reading of the board.
        readings = [board_poses(cameras[c], board, uv[c, views][:, order]) for order in board.symmetries]
        candidates = np.stack(readings) @ inverse(T_world_board[views])
        T, agreed = _most_agreed(candidates)
        for view, reading in zip(views, agreed, strict=True):
            orders[c, view] = board.symmetries[reading]
        T_cam_world[c] = T
        new = seen[c] & ~known
        T_world_board[new] = inverse(T) @ board_poses(cameras[c], board, uv[c, new])


def _most_agreed(candidates: Floats) -> tuple[Floats, list[int]]:
    """The candidate (S, V, 4, 4) that most views have one like, and which of its S readings that is for each view."""
    flat = candidates.reshape(-1, 4, 4)
    trace = np.einsum("aij,svij->asv", flat[:, :3, :3], candidates[..., :3, :3])
    angle = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    away = np.linalg.norm(flat[:, None, None, :3, 3] - candidates[..., :3, 3], axis=-1)
    distance = angle + away / max(float(np.median(np.linalg.norm(flat[:, :3, 3], axis=1))), 1e-9)
    best = int(np.argmin(np.minimum(distance.min(axis=1), _AGREE).sum(axis=1)))
    return flat[best], [int(s) for s in distance[best].argmin(axis=0)]
