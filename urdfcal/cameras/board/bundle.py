"""Bundle adjustment of a calibration from boards: lenses, camera poses and board poses in one least squares.

    r = W (uv - project(camera, T_cam_world T_world_board corner)),   W'W = (covariance of the corner + s²)^-1

The covariance is the corner's own, from the pixels around it; s, one a camera, is what the fit leaves beyond it: a
board that is not flat, a lens that is none of the model. Where the fit leaves less, the covariances are scaled down.

Poses move by a step (v, w) from the left, T <- [exp(w) v; 0 1] T. Every view's pose meets the other views only
through the cameras, so it is eliminated first (Schur complement); what remains is as large as the cameras'
parameters alone, and its inverse is their covariance.

It starts with focal length, board poses and camera places in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, frozen, inverse
from urdfcal.cameras.camera import Camera
from urdfcal.cameras.rig import by_motion, small_motion
from urdfcal.errors import CameraError
from urdfcal.rotations import skew

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.cameras.board.board import Board

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
# Half fields of view from 80° (fisheye) to 4°: focal lengths as multiples of the image's longer side.
_FOCALS = np.geomspace(0.25, 8.0, 36)
# What else is tried: a barrel lens looks like a shorter one, a fisheye like a longer one.
_RATIOS = (1.0, 0.8, 1.25, 1.6, 0.6)
# Two places of a camera that differ by more (radians, and lengths against the board's distance) do not agree.
_AGREE = 0.2
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
