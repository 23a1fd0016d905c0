"""Several cameras at once: where they stand, and the points their detections agree on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, frozen
from urdfcal.errors import CameraError
from urdfcal.rotations import rotation_vector_to_matrix, skew

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from urdfcal.cameras.camera import Camera

# Rays must cross at an angle of this many of its own standard deviations; its inverse is the relative error
# of the distance. Of 20,000 draws each, the covariance's 95 % ellipsoid holds 94.2 % at 10 (distance biased
# by 1.1 %), 91.8 % at 5 (4.4 %), 88.4 % at 3 (31 %).
_MIN_PARALLAX = 10.0
# And at 1e-5 rad whatever sigma says: there the start's normal equations have lost 10 of their 16 digits.
_MIN_ANGLE = 1e-5
# A step that moves the projections by less than a millionth of a standard deviation is the last one; for a
# sigma smaller than any real one, by less than a hundred times a pixel's rounding error.
_CONVERGED = 1e-6
_ROUNDING = 1e-10
# Of the correlations of cameras that boards calibrated, the smallest is 1e-6; rounding leaves 1e-15.
_LEAST_EIGENVALUE = 1e-12
# Pairs of one LED take 3 steps at 0.1 px of noise and 9 at 50 px; of random pairs 0.8 % still walk after 20.
_MAX_STEPS = 20


class Status(IntEnum):
    """What came of one triangulated point; anything but ``OK`` has NaN for point and covariance."""

    OK = 0
    TOO_FEW_VIEWS = 1
    OUTSIDE_LENS = 2
    PARALLEL_RAYS = 3
    BEHIND_CAMERA = 4
    NOT_CONVERGED = 5


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Points from the detections of several cameras.

    Attributes:
        points: (M, 3) m, in the world frame.
        covariances: (M, 3, 3) m², (Jᵀ W J)⁻¹ at the solution: true if the given sigma are.
        rms: (M,) root mean square of the 2 x views residuals, each divided by its sigma; no unit. With true
            sigma about sqrt(1 - 3 / (2 views)), 0.5 for two cameras; far above, the detections disagree.
        status: (M,) values of :class:`Status`.
    """

    points: Floats
    covariances: Floats
    rms: Floats
    status: Ints

    @property
    def ok(self) -> Bools:
        """(M,) which points were found."""
        return np.asarray(self.status == Status.OK)


@dataclass(frozen=True, eq=False)
class CameraSigma:
    """How well a camera is known: standard deviations from its own calibration.

    Attributes:
        parameters: (4 + k,) of the camera's parameters, in their order; 0 = exactly known.
        pose: (6,) x y z rx ry rz (m, rad) of a small motion exp6(s) after T_cam_world, in the camera's frame; None for
            the first camera and where it is not known.
        correlations: (n, m) of this camera's n values (parameters, then pose) with those of all cameras before it and
            then its own; None where they are not known. From a board, fx and fy agree to 0.97, and the
            principal point with the camera's rotation to 0.8: the prior is much tighter than its diagonal says.

    Raises:
        CameraError: a standard deviation is negative or not finite.
    """

    parameters: Floats
    pose: Floats | None = None
    correlations: Floats | None = None

    def __post_init__(self) -> None:
        for name, values in (("parameters", self.parameters), ("pose", self.pose)):
            if values is None:
                continue
            values = frozen(values)
            shaped = values.ndim == 1 and (name != "pose" or len(values) == 6)
            if not shaped or not ((values >= 0.0) & (values < np.inf)).all():
                raise CameraError(f"standard deviations {values.tolist()} of the camera's {name} make no sense")
            object.__setattr__(self, name, values)
        if self.correlations is not None:
            object.__setattr__(self, "correlations", frozen(self.correlations))

    @property
    def values(self) -> Floats:
        """(n,) all standard deviations: the parameters', then the pose's."""
        return self.parameters if self.pose is None else np.concatenate([self.parameters, self.pose])


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras and where they stand; the world frame is the first camera's.

    Cameras put up several times are several groups: the world of each is its first camera's.

    Attributes:
        cameras: with different names; none where something else measures.
        T_cam_world: for every camera (4, 4), or None where its place is not known; a group's first is the identity.
        sigmas: for every camera how well it is known, or None; left out: all None.
        scale_sigma: standard deviation of the share that the lengths between them may be too long by, as the board's
            that calibrated them; None if nothing is known.
        group: for every camera the first one of its group; left out: all are one.
        lens: for every camera the one whose lens it has, as before it was moved; left out: each its own.

    Raises:
        CameraError: a name twice, a transform that is not rigid, or standard deviations of something else.
    """

    cameras: tuple[Camera, ...] = ()
    T_cam_world: tuple[Floats | None, ...] = ()
    sigmas: tuple[CameraSigma | None, ...] = ()
    scale_sigma: float | None = None
    group: tuple[int, ...] = ()
    lens: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        object.__setattr__(self, "sigmas", tuple(self.sigmas) or (None,) * len(self.cameras))
        object.__setattr__(self, "group", tuple(self.group) or (0,) * len(self.cameras))
        object.__setattr__(self, "lens", tuple(self.lens) or tuple(range(len(self.cameras))))
        twice = sorted({name for name in self.names if self.names.count(name) > 1})
        if twice:
            raise CameraError(f"two cameras are named '{twice[0]}'", remedy="Give every camera its own name.")
        if len(self.T_cam_world) != len(self.cameras):
            raise CameraError(f"{len(self.cameras)} cameras have {len(self.T_cam_world)} transforms")
        placed = tuple(None if T is None else frozen(T) for T in self.T_cam_world)
        for name, T in zip(self.names, placed, strict=True):
            if T is not None and not _is_rigid(T):
                raise CameraError("T_cam_world is not a rigid 4 x 4 transform", where=f"camera '{name}'")
        for first in sorted(set(self.group)):
            T = placed[first]
            if T is None or not np.array_equal(T, np.eye(4)):
                what, where = "T_cam_world of the first camera is not the identity", f"camera '{self.names[first]}'"
                raise CameraError(what, where=where, remedy="The world frame is the first camera's.")
        object.__setattr__(self, "T_cam_world", placed)
        self._check_sigmas()

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names, in order."""
        return tuple(camera.name for camera in self.cameras)

    def index(self, name: str) -> int:
        """Place of the camera ``name`` in :attr:`cameras`.

        Raises:
            CameraError: there is no such camera.
        """
        if name not in self.names:
            raise CameraError(f"there is no camera '{name}'", remedy=f"There are: {', '.join(self.names)}.")
        return self.names.index(name)

    def at(self, cameras: Ints) -> Rig:
        """Return some of the cameras, (K,) indices in ascending order.

        The first one stays, or none of the others' places is known: they are counted from it.
        """
        kept = ([of[c] for c in cameras] for of in (self.group, self.lens))
        group, lens = (tuple(some.index(of) for of in some) for some in kept)
        firsts = [self.group[c] == c for c in cameras]
        places = [
            np.eye(4) if first == k and not firsts[k] else self.T_cam_world[c]
            for k, (c, first) in enumerate(zip(cameras, group, strict=True))
        ]
        counts = [0 if sigma is None else len(sigma.values) for sigma in self.sigmas]
        ends, sigmas = np.cumsum([0, *counts]), []
        for k, c in enumerate(cameras):
            sigma = self.sigmas[c]
            if sigma is not None:
                before = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in cameras[: k + 1]])
                correlations = None if sigma.correlations is None else sigma.correlations[:, before]
                sigma = replace(sigma, correlations=correlations)
            sigmas.append(sigma)
        chosen = tuple(self.cameras[c] for c in cameras)
        return Rig(chosen, tuple(places), tuple(sigmas), self.scale_sigma, group, lens)

    @property
    def correlation(self) -> Floats:
        """(P, P) of the errors of all cameras that have standard deviations, camera by camera: parameters, then pose.

        What has no correlations counts as independent.
        """
        known = [sigma for sigma in self.sigmas if sigma is not None]
        correlation, end = np.eye(sum(len(one.values) for one in known)), 0
        for one in known:
            start, end = end, end + len(one.values)
            if one.correlations is not None:
                correlation[start:end, :end] = one.correlations
                correlation[:start, start:end] = one.correlations[:, :start].T
        return correlation

    def triangulate(self, uv: Floats, sigma: ArrayLike) -> Triangulation:
        """Find the points whose projections come closest to the pixels, each weighted by its sigma.

        The start is the point nearest to all rays; Gauss-Newton in pixels follows. Cameras of unknown place
        do not take part. Whether two cameras' names are swapped shows in a second call with their columns
        exchanged: the right way round, more points are ``OK`` and their ``rms`` is far lower.

        Args:
            uv: (M, C, 2) px, NaN where a camera did not see the point.
            sigma: standard deviation of u and of v, px; any shape that broadcasts to (M, C).

        Raises:
            CameraError: the shapes do not fit, or a detection's sigma is not positive.
        """
        uv, sigma = self._checked_pixels(uv, sigma)
        placed = {i: T for i, T in enumerate(self.T_cam_world) if T is not None}
        cameras, columns = [self.cameras[i] for i in placed], list(placed)
        return _Observations(cameras, list(placed.values()), uv[:, columns], sigma[:, columns]).triangulate()

    def _check_sigmas(self) -> None:
        if len(self.sigmas) != len(self.cameras):
            raise CameraError(f"{len(self.cameras)} cameras have {len(self.sigmas)} sets of standard deviations")
        if self.scale_sigma is not None and not 0.0 <= self.scale_sigma < 1.0:
            raise CameraError(f"a standard deviation of {self.scale_sigma:g} of all lengths makes no sense")
        before = 0
        firsts = {self.cameras[c] for c in self.group}
        for camera, T, sigma in zip(self.cameras, self.T_cam_world, self.sigmas, strict=True):
            if sigma is None:
                continue
            where = f"camera '{camera.name}'"
            if sigma.parameters.shape != camera.parameters.shape:
                expected, given = len(camera.parameters), len(sigma.parameters)
                raise CameraError(f"{expected} parameters have {given} standard deviations", where=where)
            if sigma.pose is not None and (T is None or camera in firsts):
                place = "the world" if camera in firsts else "not known"
                raise CameraError(f"its place is {place}, and has no standard deviations", where=where)
            before += len(sigma.values)
            table, count = sigma.correlations, len(sigma.values)
            if table is None:
                continue
            own = table[:, -count:] if table.shape == (count, before) else None
            if own is None or not (np.abs(table) <= 1.0 + _ROUNDING).all() or not np.array_equal(own, own.T):
                what = f"its correlations are not {count} x {before} numbers from -1 to 1, its own ones symmetric"
                raise CameraError(what, where=where)
            ones = np.allclose(np.diag(own), 1.0, rtol=0.0, atol=_ROUNDING)
            if not ones or np.linalg.eigvalsh(self.correlation[:before, :before])[0] < _LEAST_EIGENVALUE:
                raise CameraError(
                    "its correlations contradict each other (not a positive definite matrix with ones on its diagonal)",
                    where=where,
                    remedy="Write all of their digits, or leave correlations out.",
                )

    def _checked_pixels(self, uv: Floats, sigma: ArrayLike) -> tuple[Floats, Floats]:
        uv = np.asarray(uv, dtype=np.float64)
        if uv.ndim != 3 or uv.shape[1:] != (len(self.cameras), 2):
            raise CameraError(f"pixels of {len(self.cameras)} cameras have the shape {uv.shape}, not (M, C, 2)")
        try:
            sigma = np.broadcast_to(np.asarray(sigma, dtype=np.float64), uv.shape[:2])
        except ValueError:
            raise CameraError(f"sigma has the shape {np.shape(sigma)}, the detections {uv.shape[:2]}") from None
        seen = np.isfinite(uv).all(axis=2)
        bad = seen & ~((sigma > 0.0) & np.isfinite(sigma))
        if bad.any():
            point, camera = np.argwhere(bad)[0]
            what = f"sigma {sigma[point, camera]:g} px of detection {point} must be positive"
            raise CameraError(what, where=f"camera '{self.names[camera]}'")
        return uv, np.where(seen, sigma, np.nan)


@dataclass(frozen=True, eq=False)
class _Observations:
    """What the C cameras of known place saw of M points: uv (M, C, 2) and sigma (M, C) px, NaN if nothing."""

    cameras: Sequence[Camera]
    T_cam_world: Sequence[Floats]
    uv: Floats
    sigma: Floats

    def triangulate(self) -> Triangulation:
        count = len(self.uv)
        seen = np.asarray(np.isfinite(self.uv).all(axis=2))
        rays = self._rays()
        status = np.full(count, Status.OK, dtype=np.intp)
        status[~self._has_parallax(rays)] = Status.PARALLEL_RAYS
        status[(seen & np.isnan(rays[..., 0])).any(axis=1)] = Status.OUTSIDE_LENS
        status[seen.sum(axis=1) < 2] = Status.TOO_FEW_VIEWS

        found = np.flatnonzero(status == Status.OK)
        start = self._nearest_to(rays[found], seen[found])
        depths = np.stack([start @ T[2, :3] + T[2, 3] for T in self.T_cam_world], axis=1)
        behind = (seen[found] & ~(depths > 0.0)).any(axis=1)
        status[found[behind]] = Status.BEHIND_CAMERA
        found = found[~behind]

        points = np.full((count, 3), np.nan)
        points[found] = start[~behind]
        limit = np.maximum(_CONVERGED, _ROUNDING / np.where(seen, self.sigma, np.inf).min(axis=1))
        moving = found
        for _ in range(_MAX_STEPS):
            H, gradient, _ = self._linearise(points[moving], moving)
            with np.errstate(invalid="ignore"):
                step = (_inverse(H) @ gradient[..., None])[..., 0]
            points[moving] += step
            # How far the step moves the projections, in squared standard deviations. After a step to behind a
            # camera it is NaN, which never converges.
            moving = moving[~(np.sum(step * gradient, axis=1) < limit[moving] ** 2)]
            if not moving.size:
                break
        status[moving] = Status.NOT_CONVERGED

        found = np.flatnonzero(status == Status.OK)
        H, _, cost = self._linearise(points[found], found)
        covariances, rms = np.full((count, 3, 3), np.nan), np.full(count, np.nan)
        covariances[found] = _inverse(H)
        rms[found] = np.sqrt(cost / (2.0 * seen[found].sum(axis=1)))
        status[found[np.isnan(cost)]] = Status.NOT_CONVERGED
        points[status == Status.NOT_CONVERGED] = np.nan
        return Triangulation(frozen(points), frozen(covariances), frozen(rms), frozen(status, np.intp))

    def _rays(self) -> Floats:
        """(M, C, 3) unit directions in the world frame; NaN where there is none."""
        rays = np.stack([camera.unproject(self.uv[:, i]) for i, camera in enumerate(self.cameras)], axis=1)
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        for i, T in enumerate(self.T_cam_world):
            rays[:, i] = rays[:, i] @ T[:3, :3]
        return rays

    def _has_parallax(self, rays: Floats) -> Bools:
        """(M,) whether any two of a point's rays cross at an angle that is more than noise."""
        crossing = np.zeros(len(rays), dtype=bool)
        angle_sigma = self.sigma / np.array([camera.intrinsics[:2].min() for camera in self.cameras])
        for i, j in combinations(range(len(self.cameras)), 2):
            sine = np.linalg.norm(np.cross(rays[:, i], rays[:, j]), axis=1)
            noise = np.hypot(angle_sigma[:, i], angle_sigma[:, j])
            crossing |= sine > np.maximum(_MIN_PARALLAX * noise, _MIN_ANGLE)
        return crossing

    def _nearest_to(self, rays: Floats, seen: Bools) -> Floats:
        """(M, 3) points with the least squared distance to their rays: Σ (1 - d dᵀ)(x - centre) = 0."""
        A, b = np.zeros((len(rays), 3, 3)), np.zeros((len(rays), 3))
        for i, T in enumerate(self.T_cam_world):
            across = np.eye(3) - rays[:, i, :, None] * rays[:, i, None, :]
            across[~seen[:, i]] = 0.0
            A += across
            b += across @ (-T[:3, :3].T @ T[:3, 3])
        return np.asarray((_inverse(A) @ b[..., None])[..., 0])

    def _linearise(self, points: Floats, rows: Ints) -> tuple[Floats, Floats, Floats]:
        """JᵀJ (k, 3, 3), Jᵀr (k, 3) and rᵀr (k,) of the whitened residuals of the detections ``rows``."""
        H, gradient, cost = np.zeros((len(rows), 3, 3)), np.zeros((len(rows), 3)), np.zeros(len(rows))
        for i, (camera, T) in enumerate(zip(self.cameras, self.T_cam_world, strict=True)):
            uv, J = camera.project_with_jacobian(points @ T[:3, :3].T + T[:3, 3])
            residual = (self.uv[rows, i] - uv) / self.sigma[rows, i, None]
            J = J @ T[:3, :3] / self.sigma[rows, i, None, None]
            unseen = ~np.isfinite(self.uv[rows, i]).all(axis=1)
            residual[unseen], J[unseen] = 0.0, 0.0
            H += np.swapaxes(J, 1, 2) @ J
            gradient += (residual[:, None, :] @ J)[:, 0]
            cost += np.sum(residual * residual, axis=1)
        return H, gradient, cost


def _inverse(H: Floats) -> Floats:
    """Inverse of symmetric (..., 3, 3) by cofactors: symmetric to the last bit, inf or NaN when singular."""
    a, b, c = H[..., 0, :], H[..., 1, :], H[..., 2, :]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    with np.errstate(all="ignore"):
        return np.asarray(cofactors / np.sum(a * cofactors[..., 0], axis=-1)[..., None, None])


def _is_rigid(T: Floats) -> bool:
    if T.shape != (4, 4) or not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        return False
    R = T[:3, :3]
    return bool(np.allclose(R @ R.T, np.eye(3), rtol=0.0, atol=1e-9) and np.linalg.det(R) > 0.0)


def by_motion(J_point: Floats, points: Floats) -> Floats:
    """Derivative (..., 2, 6) wrt a step (v, w) of the frame the ``points`` (..., 3) are in: dp = v + w x p."""
    return np.concatenate([J_point, -J_point @ skew(points)], axis=-1)


def small_motion(step: Floats) -> Floats:
    """Transforms [exp(w) v; 0 1] of steps (v, w), (..., 6) -> (..., 4, 4)."""
    T = np.zeros((*step.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation_vector_to_matrix(step[..., 3:]), step[..., :3], 1.0
    return T
