"""What an estimated lens leaves unknown of where light falls in the image (METHOD 12)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.blocks.cameras import camera_values, lens_key_of
from urdfcal.rotations import skew

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution


def projection_sigma(
    problem: Problem, fit: Solution, camera: int, uv: Floats, seen: Floats, distance: Floats
) -> Floats | None:
    """Compute how well an estimated lens tells where rays fall in its image.

    The covariance of the lens carried to the pixels, less what a motion of the camera takes away where it has seen
    something: where it stands is estimated with its lens, and a shifted principal point is a turned camera but for
    little, a longer focal length one that is farther away (mrcal's projection uncertainty does alike).

    Args:
        problem: the cameras.
        fit: the estimate.
        camera: index of the camera.
        uv: (N, 2) where in the image. [px]
        seen: (M, 2) what it has seen. [px]
        distance: (M,) how far away. [m]

    Returns:
        (N,) root of the covariance's trace at the median distance, NaN where the lens has no ray; None where the lens
        is not estimated, or has seen nothing. [px]
    """
    where, active = fit.parameters.active_columns(lens_key_of(problem.attachments, camera))
    if not active.any() or not len(seen):
        return None
    lens = camera_values(problem.attachments, fit.state)[camera]

    def derivatives(places: Floats, distance: Floats) -> tuple[Floats, Floats]:
        """Of pixels by the camera's motion (N, 2, 6), and by its lens (N, 2, k)."""
        rays = lens.unproject(places)
        points = rays * (distance / np.linalg.norm(rays, axis=1))[:, None]
        _, by_point, by_lens = lens.project_with_derivatives(points)
        return np.concatenate([by_point, -by_point @ skew(points)], axis=2), by_lens[..., active]

    known = np.isfinite(lens.unproject(seen)).all(axis=1)
    moved, A = derivatives(seen[known], distance[known])
    motion = np.linalg.lstsq(moved.reshape(-1, 6), A.reshape(-1, A.shape[-1]), rcond=None)[0]
    sigma, there = np.full(len(uv), np.nan), np.isfinite(lens.unproject(uv)).all(axis=1)
    moved, A = derivatives(uv[there], np.full(np.count_nonzero(there), np.median(distance)))
    A = A - moved @ motion
    sigma[there] = np.sqrt(np.maximum(np.einsum("nij,jk,nik->n", A, fit.covariance[where, where], A), 0.0))
    return sigma
