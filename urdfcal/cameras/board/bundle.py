"""Bundle adjustment of a calibration from boards: lenses, camera poses and board poses in one least squares.

    r = (uv - project(camera, T_cam_world T_world_board corner)) / sigma

Poses move by a step (v, w) from the left, T <- [exp(w) v; 0 1] T. Every view's pose meets the other views only
through the cameras, so it is eliminated first (Schur complement); what remains is as large as the cameras'
parameters alone, and its inverse is their covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, frozen
from urdfcal.cameras.rig import by_motion, small_motion
from urdfcal.errors import CameraError

if TYPE_CHECKING:
    from urdfcal.cameras.board.board import Board
    from urdfcal.cameras.camera import Camera

# A step shorter than this many standard deviations of the parameters, all together, is the last.
_CONVERGED = 1e-3
_MAX_STEPS = 100
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e12
# Deviations of a two-dimensional Gaussian beyond 3 sigma are one in ninety, beyond 6 one in 66 million.
_HUBER, _CUT = 3.0, 6.0
# Sigma and weights settle to this within 2 or 3 rounds.
_ROUNDS, _SETTLED = 6, 1e-3
# A corner cannot be read better than this, px; keeps images without noise from a division by zero.
_LEAST_SIGMA = 1e-4
# A fit that leaves out more corners than it explains is none.
_LEAST_SHARE = 0.5
_MORE = "Check the board's size; add images with the board tilted in different directions, all over the image."


@dataclass(frozen=True, eq=False)
class Bundle:
    """Cameras and boards, estimated or to be.

    Attributes:
        board: its corners.
        cameras: C cameras.
        T_cam_world: (C, 4, 4); the first is the identity and stays it.
        T_world_board: (V, 4, 4).
    """

    board: Board
    cameras: tuple[Camera, ...]
    T_cam_world: Floats
    T_world_board: Floats

    @property
    def columns(self) -> tuple[Ints, ...]:
        """Where each camera's parameters are among all: its lens's, and after all lenses the pose's but the first's."""
        ends = np.cumsum([0, *(len(camera.parameters) for camera in self.cameras)])
        poses = ends[-1] + np.arange(6 * (len(self.cameras) - 1)).reshape(-1, 6)
        lenses = [np.arange(a, b) for a, b in pairwise(ends)]
        return (lenses[0], *(np.concatenate(both) for both in zip(lenses[1:], poses, strict=True)))

    @property
    def size(self) -> int:
        """Number of the cameras' parameters."""
        return sum(map(len, self.columns))

    def project(self) -> Floats:
        """(C, V, N, 2) px of all corners; NaN where a camera cannot see one."""
        points = self.board.at(self.T_world_board)
        each = zip(self.cameras, self.T_cam_world, strict=True)
        return np.stack([camera.project(points @ T[:3, :3].T + T[:3, 3]) for camera, T in each])

    def moved(self, shared: Floats, views: Floats) -> Bundle:
        """Step the cameras' parameters by ``shared`` (size,) and the boards by ``views`` (V, 6).

        Raises:
            CameraError: a camera has become none.
        """
        cameras, places = [], []
        for camera, T, columns in zip(self.cameras, self.T_cam_world, self.columns, strict=True):
            lens, pose = np.split(shared[columns], [len(camera.parameters)])
            cameras.append(camera.with_parameters(camera.parameters + lens))
            places.append(small_motion(pose) @ T if len(pose) else T)
        boards = small_motion(views) @ self.T_world_board
        return replace(self, cameras=tuple(cameras), T_cam_world=np.stack(places), T_world_board=boards)

    def normal_equations(self, uv: Floats, weights: Floats) -> _Normal:
        """Accumulate JᵀWJ and JᵀWr; ``weights`` (C, V, N) are 1 / sigma², zero where there is no corner."""
        V, N = uv.shape[1:3]
        points = self.board.at(self.T_world_board)
        shared, g_shared, mixed = np.zeros((self.size, self.size)), np.zeros(self.size), np.zeros((V, self.size, 6))
        boards, g_boards, cost = np.zeros((V, 6, 6)), np.zeros((V, 6)), 0.0
        for c, (camera, T, columns) in enumerate(zip(self.cameras, self.T_cam_world, self.columns, strict=True)):
            p = points @ T[:3, :3].T + T[:3, 3]
            predicted, J_point, J_lens = camera.project_with_derivatives(p)
            used = weights[c] > 0.0
            root = np.sqrt(weights[c])[..., None]
            r = np.where(used[..., None], uv[c] - predicted, 0.0) * root
            if np.isnan(r).any():
                cost = np.inf
                break
            J_point = np.where(used[..., None, None], J_point, 0.0) * root[..., None]
            J_lens = np.where(used[..., None, None], J_lens, 0.0) * root[..., None]
            r = r.reshape(V, 2 * N, 1)
            J_board = by_motion(J_point @ T[:3, :3], points).reshape(V, 2 * N, 6)
            # The first camera's pose has no columns.
            J = np.concatenate([J_lens, by_motion(J_point, p)], axis=-1)[..., : len(columns)].reshape(V, 2 * N, -1)
            Jt, Jt_board = np.swapaxes(J, 1, 2), np.swapaxes(J_board, 1, 2)
            shared[np.ix_(columns, columns)] += (Jt @ J).sum(axis=0)
            g_shared[columns] += (Jt @ r)[..., 0].sum(axis=0)
            mixed[:, columns] += Jt @ J_board
            boards += Jt_board @ J_board
            g_boards += (Jt_board @ r)[..., 0]
            cost += float((r * r).sum())
        return _Normal(shared, g_shared, mixed, boards, g_boards, cost)


@dataclass(frozen=True, eq=False)
class _Normal:
    """JᵀJ by blocks: cameras (P, P), cameras with views (V, P, 6), views (V, 6, 6); the gradients, and rᵀr."""

    shared: Floats
    g_shared: Floats
    mixed: Floats
    views: Floats
    g_views: Floats
    cost: float

    def solve(self, damping: float) -> tuple[Floats, Floats, Floats]:
        """The damped step of the cameras and of the views, and the covariance of the cameras' parameters."""
        scale = np.sqrt(np.maximum(np.diag(self.shared), 1e-300))
        shared = self.shared + damping * np.diag(scale**2)
        views = self.views + damping * np.eye(6) * np.einsum("vii->vi", self.views)[:, None, :]
        inverse = np.linalg.pinv(views, hermitian=True)
        eliminated = self.mixed @ inverse
        S = shared - (eliminated @ np.swapaxes(self.mixed, 1, 2)).sum(axis=0)
        g = self.g_shared - (eliminated @ self.g_views[..., None])[..., 0].sum(axis=0)
        covariance = np.linalg.pinv(S / np.outer(scale, scale), rcond=1e-14, hermitian=True) / np.outer(scale, scale)
        step = covariance @ g
        rest = self.g_views - (np.swapaxes(self.mixed, 1, 2) @ step)
        return step, (inverse @ rest[..., None])[..., 0], covariance

    def length(self, shared: Floats, views: Floats) -> float:
        """How many standard deviations a step is long."""
        squared = shared @ self.shared @ shared + 2.0 * np.einsum("p,vpi,vi", shared, self.mixed, views)
        return float(np.sqrt(max(0.0, squared + np.einsum("vi,vij,vj", views, self.views, views))))


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A bundle adjusted to corners.

    Attributes:
        bundle: cameras and boards.
        covariance: (P, P) of the cameras' parameters, in the order of the bundle's slices.
        sigma: (C,) standard deviation of a corner's coordinate in each camera, px, from the residuals.
        residuals: (C, V, N, 2) px, NaN where there was no corner.
        outliers: (C, V, N) corners that were left out.
    """

    bundle: Bundle
    covariance: Floats
    sigma: Floats
    residuals: Floats
    outliers: Bools


def adjust(bundle: Bundle, uv: Floats) -> Adjusted:
    """Adjust ``bundle`` to the corners ``uv`` (C, V, N, 2), with weights from their own residuals.

    Raises:
        CameraError: the start explains nothing, or the fit does not converge.
    """
    seen = np.isfinite(uv[..., 0])
    if not np.isfinite(bundle.normal_equations(uv, seen.astype(float)).cost):
        raise CameraError("the start puts a board outside a lens")
    weights = seen.astype(float)
    sigma = np.ones(len(uv))
    for _ in range(_ROUNDS):
        bundle = _descend(bundle, uv, weights)
        residuals = uv - bundle.project()
        # A corner left out may have come to lie beyond the lens.
        distance = np.nan_to_num(np.linalg.norm(residuals, axis=-1), nan=np.inf)
        before, sigma = sigma, _noise(distance, seen, bundle)
        norms = distance / sigma[:, None, None]
        huber = _HUBER / np.maximum(norms, _HUBER)
        weights = np.where(seen & (norms < _CUT), huber, 0.0) / sigma[:, None, None] ** 2
        if np.allclose(sigma, before, rtol=_SETTLED, atol=0.0):
            break
    if np.count_nonzero(weights) < _LEAST_SHARE * np.count_nonzero(seen):
        raise CameraError("the corners do not agree on any camera", remedy=_MORE)
    _, _, covariance = bundle.normal_equations(uv, weights).solve(0.0)
    return Adjusted(bundle, frozen(covariance), frozen(sigma), residuals, seen & (weights == 0.0))


def _noise(distance: Floats, seen: Floats, bundle: Bundle) -> Floats:
    """(C,) standard deviations of a coordinate: rms of each camera's residuals without those far beyond the others'."""
    counted = 2 * int(seen.sum())
    unknown = bundle.size + 6 * len(bundle.T_world_board)
    # What the fit has taken away from the residuals, shared out evenly.
    inflation = np.sqrt(counted / max(counted - unknown, 1))
    sigma = []
    for camera in range(len(distance)):
        d = distance[camera][seen[camera] & np.isfinite(distance[camera])]
        if not d.size:
            raise CameraError("the corners do not agree on any camera", remedy=_MORE)
        # The median of a Rayleigh distribution is 1.1774 sigma.
        rough = max(float(np.median(d)) / 1.1774, _LEAST_SIGMA)
        kept = d[d < _CUT * rough]
        sigma.append(max(float(np.sqrt(np.mean(kept**2) / 2.0)), _LEAST_SIGMA) * inflation)
    return np.array(sigma)


def _descend(bundle: Bundle, uv: Floats, weights: Floats) -> Bundle:
    """Levenberg-Marquardt with fixed weights."""
    at = bundle.normal_equations(uv, weights)
    damping = _FIRST_DAMPING
    for _ in range(_MAX_STEPS):
        shared, views, _ = at.solve(damping)
        try:
            candidate = bundle.moved(shared, views)
            new = candidate.normal_equations(uv, weights)
        except CameraError:
            new = replace(at, cost=np.inf)
        if not new.cost <= at.cost * (1.0 + 1e-12):
            damping *= 10.0
            if damping > _MOST_DAMPING:
                return bundle
            continue
        length = at.length(shared, views)
        bundle, at, damping = candidate, new, max(0.1 * damping, 1e-12)
        # With weights of 1 / px² the length is in px of all corners together: just as good a measure.
        if length < _CONVERGED:
            return bundle
    raise CameraError("the calibration of the cameras does not converge", remedy=_MORE)
