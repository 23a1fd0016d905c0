"""Bundle adjustment of a calibration from boards: lenses, camera poses and board poses in one least squares.

    r = W (uv - project(camera, T_cam_world T_world_board corner)),   W'W = (covariance of the corner + s²)^-1

The covariance is the corner's own, from the pixels around it; s, one a camera, is what the fit leaves beyond it: a
board that is not flat, a lens that is none of the model. Where the fit leaves less, the covariances are scaled down.

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
    from collections.abc import Callable

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
# Views contradict each other from this many standard deviations of the sum of their squares on, and a view
# that alone tells a parameter tells nothing of its error. Halves of a real set of 13 pairs differ by 2.9 standard
# deviations (rms) of what independent corners say.
_BY_CHANCE, _LEAST_LEFT = 2.0, 0.05
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

    def normal_equations(self, uv: Floats, whitening: Floats) -> _Normal:
        """Accumulate JᵀJ and Jᵀr of what ``whitening`` (C, V, N, 2, 2) makes of the residuals; zero: no corner."""
        V, N = uv.shape[1:3]
        points = self.board.at(self.T_world_board)
        P = self.size
        shared, g_shared, mixed = np.zeros((V, P, P)), np.zeros((V, P)), np.zeros((V, P, 6))
        boards, g_boards, cost = np.zeros((V, 6, 6)), np.zeros((V, 6)), 0.0
        for c, (camera, T, columns) in enumerate(zip(self.cameras, self.T_cam_world, self.columns, strict=True)):
            p = points @ T[:3, :3].T + T[:3, 3]
            predicted, J_point, J_lens = camera.project_with_derivatives(p)
            W = whitening[c]
            used = W.any(axis=(-2, -1))
            r = W @ np.where(used[..., None], uv[c] - predicted, 0.0)[..., None]
            if np.isnan(r).any():
                cost = np.inf
                break
            J_point, J_lens = (W @ np.where(used[..., None, None], J, 0.0) for J in (J_point, J_lens))
            r = r.reshape(V, 2 * N, 1)
            J_board = by_motion(J_point @ T[:3, :3], points).reshape(V, 2 * N, 6)
            # The first camera's pose has no columns.
            J = np.concatenate([J_lens, by_motion(J_point, p)], axis=-1)[..., : len(columns)].reshape(V, 2 * N, -1)
            Jt, Jt_board = np.swapaxes(J, 1, 2), np.swapaxes(J_board, 1, 2)
            shared[:, columns[:, None], columns] += Jt @ J
            g_shared[:, columns] += (Jt @ r)[..., 0]
            mixed[:, columns] += Jt @ J_board
            boards += Jt_board @ J_board
            g_boards += (Jt_board @ r)[..., 0]
            cost += float((r * r).sum())
        return _Normal(shared, g_shared, mixed, boards, g_boards, cost)


@dataclass(frozen=True, eq=False)
class _Normal:
    """JᵀJ of each view by blocks: cameras (V, P, P), with its board (V, P, 6), board (V, 6, 6); gradients, and rᵀr."""

    shared: Floats
    g_shared: Floats
    mixed: Floats
    views: Floats
    g_views: Floats
    cost: float

    def solve(self, damping: float) -> tuple[Floats, Floats, Floats]:
        """The damped step of the cameras and of the views, and the covariance of the cameras' parameters."""
        total = self.shared.sum(axis=0)
        scale = np.sqrt(np.maximum(np.diag(total), 1e-300))
        each, gradients, inverse = self._eliminated(damping)
        S = each.sum(axis=0) + damping * np.diag(scale**2)
        covariance = np.linalg.pinv(S / np.outer(scale, scale), rcond=1e-14, hermitian=True) / np.outer(scale, scale)
        step = covariance @ gradients.sum(axis=0)
        rest = self.g_views - (np.swapaxes(self.mixed, 1, 2) @ step)
        return step, (inverse @ rest[..., None])[..., 0], covariance

    def covariance(self) -> Floats:
        """(P, P) of the cameras' parameters, wider than JᵀJ says where the views contradict each other.

        The corners of one view err together: a board that is bent, or a lens that is none of the model. With every
        view's gradient a = L's, LL' the covariance of independent corners, and its share h = L'SL of the information,
        (1 - h)^(-1/2) a has the covariance h if they are independent, so these add up to the identity (MacKinnon and
        White's HC2, by views). Where they add up to more than chance, their sum, shrunk towards its mean, takes its
        place; nowhere is the result smaller.
        """
        covariance = self.solve(0.0)[2]
        S, gradients, _ = self._eliminated(0.0)
        used = np.einsum("vii->v", S) > 0.0
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        V, P = int(used.sum()), len(covariance)
        shares, axes = np.linalg.eigh(root.T @ S[used] @ root)
        a = np.swapaxes(axes, 1, 2) @ (root.T @ gradients[used][..., None])
        a = (axes @ (a / np.sqrt(np.maximum(1.0 - shares, _LEAST_LEFT))[..., None]))[..., 0]
        found = a.T @ a
        ratio = float(np.trace(found)) / P
        if ratio < 1.0 + _BY_CHANCE * np.sqrt(2.0 / (P * V)):
            return covariance
        shrunk, axes = np.linalg.eigh((V * found + P * ratio * np.eye(P)) / (V + P))
        root = root @ axes * np.sqrt(np.maximum(shrunk, 1.0))
        return np.asarray(root @ root.T)

    def _eliminated(self, damping: float) -> tuple[Floats, Floats, Floats]:
        """Each view's JᵀJ (V, P, P) and gradient (V, P) without its board, and the inverse of its board's block."""
        views = self.views + damping * np.eye(6) * np.einsum("vii->vi", self.views)[:, None, :]
        inverse = np.linalg.pinv(views, hermitian=True)
        eliminated = self.mixed @ inverse
        S = self.shared - eliminated @ np.swapaxes(self.mixed, 1, 2)
        return S, self.g_shared - (eliminated @ self.g_views[..., None])[..., 0], inverse

    def length(self, shared: Floats, views: Floats) -> float:
        """How many standard deviations a step is long."""
        squared = shared @ self.shared.sum(axis=0) @ shared + 2.0 * np.einsum("p,vpi,vi", shared, self.mixed, views)
        return float(np.sqrt(max(0.0, squared + np.einsum("vi,vij,vj", views, self.views, views))))


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A bundle adjusted to corners.

    Attributes:
        bundle: cameras and boards.
        covariance: (P, P) of the cameras' parameters, in the order of the bundle's slices.
        sigma: (C,) standard deviation of a corner's coordinate in each camera, px, from the residuals.
        residuals: (C, V, N, 2) px, NaN where there was no corner.
        norms: (C, V, N) the residuals' lengths in standard deviations, 1.4 rms if all is well; NaN likewise.
        outliers: (C, V, N) corners that were left out.
    """

    bundle: Bundle
    covariance: Floats
    sigma: Floats
    residuals: Floats
    norms: Floats
    outliers: Bools


def adjust(bundle: Bundle, uv: Floats, covariance: Floats) -> Adjusted:
    """Adjust ``bundle`` to the corners ``uv`` (C, V, N, 2) of ``covariance`` (C, V, N, 2, 2), px², a lower bound.

    Raises:
        CameraError: the start explains nothing, or the fit does not converge.
    """
    seen = np.isfinite(uv[..., 0])
    whitening = seen[..., None, None] * np.eye(2)
    if not np.isfinite(bundle.normal_equations(uv, whitening).cost):
        raise CameraError("the start puts a board outside a lens")
    sigma = np.ones(len(uv))
    # What the fit has taken away from the residuals, shared out evenly.
    freedom = 1.0 - min((bundle.size + 6.0 * len(bundle.T_world_board)) / (2.0 * max(seen.sum(), 1)), 0.99)
    for _ in range(_ROUNDS):
        bundle = _descend(bundle, uv, whitening)
        residuals = uv - bundle.project()
        before = sigma
        each = zip(residuals, covariance, seen, strict=True)
        unit, norms, sigma = (
            np.stack(values) for values in zip(*(_weighed(*one, freedom) for one in each), strict=True)
        )
        huber = np.sqrt(_HUBER / np.maximum(norms, _HUBER))
        whitening = np.where(seen & (norms < _CUT), huber, 0.0)[..., None, None] * unit
        if np.allclose(sigma, before, rtol=_SETTLED, atol=0.0):
            break
    used = whitening.any(axis=(-2, -1))
    if np.count_nonzero(used) < _LEAST_SHARE * np.count_nonzero(seen):
        raise CameraError("the corners do not agree on any camera", remedy=_MORE)
    found = bundle.normal_equations(uv, whitening).covariance()
    return Adjusted(bundle, frozen(found), frozen(sigma), residuals, np.where(seen, norms, np.nan), seen & ~used)


def _weighed(residuals: Floats, covariance: Floats, seen: Bools, freedom: float) -> tuple[Floats, Floats, float]:
    """What one camera's residuals (V, N, 2) say of the noise.

    Returns:
        (V, N, 2, 2) what whitens each, (V, N) their lengths in standard deviations, infinite beyond the lens, and the
        standard deviation of a coordinate, px, rms over the corners.
    """
    known = seen & np.isfinite(residuals).all(axis=-1)
    if not known.any():
        raise CameraError("the corners do not agree on any camera", remedy=_MORE)
    r, C = residuals[known], covariance[known]
    # In its axes every covariance is two variances.
    variances, axes = np.linalg.eigh(C)
    squared = (np.swapaxes(axes, 1, 2) @ r[..., None])[..., 0] ** 2

    def lengths(extra: float) -> Floats:
        return np.asarray((squared / np.maximum(variances + extra, _LEAST_SIGMA**2)).sum(axis=1))

    # The median of the squared lengths of two-dimensional Gaussians is 2 ln 2, their mean 2; far ones do not count.
    rough = _extra(lambda extra: float(np.median(lengths(extra))) / (2.0 * np.log(2.0)) / freedom, squared)
    kept = lengths(rough) < _CUT**2
    extra = _extra(lambda extra: float(lengths(extra)[kept].mean()) / 2.0 / freedom, squared)
    variances = np.maximum(variances + extra, _LEAST_SIGMA**2)
    # Where the corners are better than they claim, their covariances shrink together.
    variances *= min(1.0, max(float((squared / variances)[kept].mean()) / freedom, 1e-6))
    variances = np.maximum(variances, _LEAST_SIGMA**2)
    whitening = np.zeros((*seen.shape, 2, 2))
    norms = np.full(seen.shape, np.inf)
    whitening[known] = np.swapaxes(axes, 1, 2) / np.sqrt(variances)[..., None]
    norms[known] = np.sqrt((squared / variances).sum(axis=1))
    return whitening, norms, float(np.sqrt(squared[kept].mean() / freedom))


def _extra(chi2: Callable[[float], float], squared: Floats) -> float:
    """The variance, px², that makes ``chi2``, a falling function of it, one; 0 if it is less than one already."""
    low, high = _LEAST_SIGMA**2, 4.0 * float(squared.max()) + _LEAST_SIGMA**2
    if chi2(0.0) <= 1.0:
        return 0.0
    for _ in range(60):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if chi2(middle) > 1.0 else (low, middle)
    return float(high)


def _descend(bundle: Bundle, uv: Floats, whitening: Floats) -> Bundle:
    """Levenberg-Marquardt with fixed weights."""
    at = bundle.normal_equations(uv, whitening)
    damping = _FIRST_DAMPING
    for _ in range(_MAX_STEPS):
        shared, views, _ = at.solve(damping)
        try:
            candidate = bundle.moved(shared, views)
            new = candidate.normal_equations(uv, whitening)
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
