"""What there is to see of a calibration, as numbers: everything stands in the base link's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, Ints, inverse
from urdfcal.cameras.rig import Rig
from urdfcal.output.placing import Places
from urdfcal.output.rows import dh_frames, row_corners, row_offsets
from urdfcal.rotations import skew

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from urdfcal.estimation.snapshot import Snapshot
    from urdfcal.pipeline import FittedCalibration
    from urdfcal.session.attachments import Attachments

    Bools = NDArray[np.bool_]

LENGTHS = ("d", "a", "x", "y", "z")
"""Parameters in m; the others are in rad."""

UNITS = {2: ("px", 1.0), 3: ("mm", 1e3)}
"""Name and scale of the unit that residuals are shown in, by their dimension: px, or mm for points."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """Measurements of one kind as a table, one row each, ordered by pose: pixels (D = 2) or points (D = 3).

    Attributes:
        pose: (S,) index of the pose.
        led: (S,) index of the LED.
        camera: (S,) index of the camera; -1 for points.
        measured: (S, D) in px of the camera, or m in the world.
        sigma: (S,) standard deviation of each component.
        predicted: (S, D) by the calibrated arm.
        nominal: (S, D) by the arm as drawn.
        size: (S,) rms of the whitened residual's components after calibration: about 1 where the noise is as declared.
        size_nominal: (S,) the same for the arm as drawn.
        outlier: (S,) whether it was taken out of the fit.
    """

    pose: Ints
    led: Ints
    camera: Ints
    measured: Floats
    sigma: Floats
    predicted: Floats
    nominal: Floats
    size: Floats
    size_nominal: Floats
    outlier: Bools


@dataclass(frozen=True, eq=False)
class Leds:
    """LEDs in space, one row for every LED and pose at which it was measured, ordered by pose.

    What cameras that stand still and cameras on different links see of one LED are rows of their own.

    Attributes:
        pose: (M,) index of the pose.
        led: (M,) index of the LED.
        measured: (M, 3) triangulated, or the tracker's point, in the base link's frame. [m]
        predicted: (M, 3) by the calibrated arm. [m]
        nominal: (M, 3) by the arm as drawn, as it lies to the calibrated one for who looks on: in the world, or as
            seen from the link that the camera rides on. [m]
        size: (M,) of the residual after calibration, in standard deviations (rms over the LED's sightings).
        size_nominal: (M,) the same for the arm as drawn.
        outlier: (M,) whether one of its sightings was taken out of the fit.
        covariance: (M, 3, 3) of the measurement, by the declared noise; NaN where a single camera saw it. [m2]
    """

    pose: Ints
    led: Ints
    measured: Floats
    predicted: Floats
    nominal: Floats
    size: Floats
    size_nominal: Floats
    outlier: Bools
    covariance: Floats


@dataclass(frozen=True, eq=False)
class Scene:
    """A calibration laid out in the base link's frame, at N poses of n joints with R DH rows.

    Attributes:
        frames: (N, n + 1, 4, 4) base link and joint frames of the calibrated arm. [m]
        ghost: (N, n + 1, 4, 4) those of the arm as drawn, their deviation from the calibrated arm enlarged. [m]
        dh: (N, R + 1, 4, 4) DH frames F_0 ... F_R of the calibrated arm. [m]
        corners: (N, R, 3, 3) where each row starts, where its common normal leaves its axis, where it ends. [m]
        views: (C, N, 4, 4) camera frames. [m]
        links: (C,) for each camera the link that it rides on, None where it stands still.
        leds: where the LEDs were measured and predicted.
        tables: the measurements, each kind that there is.
        rays: (S, 2, 3) for every row of ``pixels``: the camera, and the point of the sighting's ray as far away as
            the predicted LED; NaN where the lens model has no ray. [m]
        factor: how many times deviations and residuals in space are enlarged.
        pixel_factor: how many times residuals of the arm as drawn are enlarged in the pictures.
        field_factor: how many times those of the calibrated arm are.
    """

    frames: Floats
    ghost: Floats
    dh: Floats
    corners: Floats
    views: Floats
    links: tuple[str | None, ...]
    leds: Leds
    tables: tuple[Sightings, ...]
    rays: Floats
    factor: float
    pixel_factor: float
    field_factor: float

    @property
    def T_base_cam(self) -> Floats:
        """(C, 4, 4) camera frames at the first pose: at all of them where a camera stands still. [m]."""
        return self.views[:, 0]

    @property
    def pixels(self) -> Sightings | None:
        """What the cameras saw, if there are any."""
        return pixels_of(self.tables)


def pixels_of(tables: tuple[Sightings, ...]) -> Sightings | None:
    """The table of pixels among others."""
    return next((table for table in tables if table.measured.shape[1] == 2), None)


def lay_out(calibration: FittedCalibration) -> Scene:
    """Work out where everything of a calibration stands, seen from the base link."""
    session, table, estimate = calibration.session, calibration.table, calibration.estimate
    places = Places.of(calibration, estimate, session.q)
    # The two arms are compared in what they share, the world or the link that watches, seen by the same cameras
    # (wrong lenses would put the drawn arm anywhere); the calibrated base carries the picture.
    drawn = Places.of(calibration, calibration.snapshot(calibration.comparison.drawn.fit.state), session.q)
    T_base_drawn = places.T_base_frame @ inverse(drawn.T_base_frame)
    nominal = T_base_drawn[0, :, None] @ drawn.frames
    nominal_leds = np.einsum("fnij,nlj->fnli", T_base_drawn[..., :3, :3], drawn.leds) + T_base_drawn[:, :, None, :3, 3]
    tables = tuple(_tabulated(calibration, index) for index in range(len(calibration.observations)))
    pixels = pixels_of(tables)
    rays = _rays(pixels, estimate, places) if pixels else np.zeros((0, 2, 3))
    parts = [_leds(block, estimate, session.attachments, rays, places, nominal_leds) for block in tables]
    leds = parts[0] if len(parts) == 1 else _merged(parts)
    apart = np.linalg.norm(nominal[..., :3, 3] - places.frames[..., :3, 3], axis=-1).mean(axis=0).max()
    offsets = row_offsets(calibration, estimate)
    dh = dh_frames(table, offsets, places.frames)
    factor = readable(max(float(apart), _typical(leds.nominal - leds.measured)), 0.1 * table.chain.reach)
    width = float(np.mean([camera.resolution[0] for camera in estimate.cameras])) if pixels else 0.0
    links = (None, *(tip.link for tip in session.attachments.tips))
    return Scene(
        frames=places.frames,
        ghost=exaggerated(places.frames, nominal, factor),
        dh=dh,
        corners=row_corners(table, offsets, places.frames, dh),
        views=places.T_base_cam,
        links=tuple(links[frame] for frame in session.attachments.camera[: len(estimate.cameras)]),
        leds=leds,
        tables=tables,
        rays=rays,
        factor=factor,
        pixel_factor=readable(_typical(pixels.nominal - pixels.measured), 0.05 * width) if pixels else 1.0,
        field_factor=readable(_typical(pixels.predicted - pixels.measured), 0.03 * width) if pixels else 1.0,
    )


def _tabulated(calibration: FittedCalibration, index: int) -> Sightings:
    """Bring one of the calibration's blocks of observations, and what became of it, into a table."""
    block, fit = calibration.observations[index], calibration.fit
    rows = block.valid

    def size(deviation: Floats) -> Floats:
        result: Floats = deviation[rows] / np.sqrt(block.dimension)
        return result

    return Sightings(
        pose=np.broadcast_to(block.pose[:, None], rows.shape)[rows],
        led=block.index["led"][rows],
        camera=block.index.get("camera", np.full_like(block.row, -1))[rows],
        measured=block.value[rows],
        sigma=np.sqrt(block.covariance[rows][:, 0, 0]),
        predicted=calibration.problem.predict(block, calibration.fit.state)[rows],
        nominal=calibration.problem.predict(block, calibration.nominal_fit.state)[rows],
        size=size(fit.norms[index]),
        size_nominal=size(calibration.nominal_fit.norms[index]),
        outlier=fit.outlier[index][rows],
    )


def exaggerated(T_base_here: Floats, T_base_there: Floats, factor: float) -> Floats:
    """Go from frames towards their counterparts and ``factor`` times as far, (..., 4, 4)."""
    R = np.swapaxes(T_base_here[..., :3, :3], -1, -2) @ T_base_there[..., :3, :3]
    twice = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    sine = np.linalg.norm(twice, axis=-1) / 2
    angle = factor * np.arctan2(sine, (np.trace(R, axis1=-2, axis2=-1) - 1) / 2)[..., None, None]
    axis = skew(twice / np.maximum(2 * sine, np.finfo(float).tiny)[..., None])
    T: Floats = T_base_here.copy()
    T[..., :3, :3] @= np.eye(3) + np.sin(angle) * axis + (1 - np.cos(angle)) * (axis @ axis)
    T[..., :3, 3] += factor * (T_base_there[..., :3, 3] - T_base_here[..., :3, 3])
    return T


def readable(length: float, target: float) -> float:
    """The factor 1, 2, 5, 10 ... 1000 that draws a length at most as long as ``target``."""
    steps = np.outer(10.0 ** np.arange(4), [1, 2, 5]).ravel()[:10]
    return float(steps[np.searchsorted(steps[1:], target / length)]) if length > 0 else 1.0


def picture_range(resolution: tuple[int, int], seen: Floats) -> tuple[tuple[float, float], tuple[float, float]]:
    """The range of u and of v that holds a camera's picture and all sightings (S, 2), even those that lie outside."""
    corners = np.concatenate([[[0, 0], resolution], seen])
    (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
    margin = 0.01 * max(resolution)
    return (float(left - margin), float(right + margin)), (float(top - margin), float(bottom + margin))


def rms_by_pose(pose: Ints, residuals: Floats) -> tuple[Ints, Floats]:
    """Root mean square length of the residuals (S, D) of each pose that has any."""
    count = np.bincount(pose)
    total = np.bincount(pose, np.sum(residuals**2, axis=1))
    poses = np.flatnonzero(count)
    return poses, np.sqrt(total[poses] / count[poses])


def _typical(vectors: Floats) -> float:
    """Median length of vectors (S, D), those that could not be predicted left out."""
    return float(np.nanmedian(np.linalg.norm(vectors, axis=-1)))


def _rays(pixels: Sightings, state: Snapshot, places: Places) -> Floats:
    T = places.T_base_cam[pixels.camera, pixels.pose]
    depth = np.einsum("si,si->s", T[:, :3, 2], places.leds[pixels.pose, pixels.led] - T[:, :3, 3])
    ray = np.empty((len(T), 3))
    for c, camera in enumerate(state.cameras):
        ray[pixels.camera == c] = camera.unproject(pixels.measured[pixels.camera == c])
    end = T[:, :3, 3] + np.einsum("sij,sj->si", T[:, :3, :3], ray * depth[:, None])
    return np.stack([T[:, :3, 3], end], axis=1)


def _leds(
    block: Sightings, state: Snapshot, fastened: Attachments, rays: Floats, places: Places, nominal: Floats
) -> Leds:
    """Gather sightings of an LED at a pose; nominal LEDs (F, N, L, 3) as seen from each frame that cameras are in."""
    in_space = block.measured.shape[1] == 3
    view = np.zeros_like(block.camera) if in_space else fastened.camera[block.camera]
    shape = (len(places.frames), len(state.leds), len(places.T_base_frame))
    keys, row = np.unique(np.ravel_multi_index((block.pose, block.led, view), shape), return_inverse=True)
    pose, led, view = np.unravel_index(keys, shape)
    # A tracker measures every LED once a pose: the keys are in its table's order.
    if in_space:
        T_base_world = places.T_base_frame[0, pose]
        measured, covariance = _moved(T_base_world, block.measured, block.sigma[:, None, None] ** 2 * np.eye(3))
    else:
        measured, covariance = _triangulated(block, state, fastened, places, row, pose, view)
    # Where a single camera sees an LED there is no distance: its ray stands in, at the predicted one.
    alone = np.isnan(measured[row]).any(axis=1)
    if alone.any():
        measured[row[alone]] = rays[alone, 1]
    somewhere = np.isfinite(measured).all(axis=1)  # not where the lens model has no ray for the pixel

    def rms(size: Floats) -> Floats:
        result: Floats = np.sqrt(np.bincount(row, size**2) / np.bincount(row))[somewhere]
        return result

    return Leds(
        pose=pose[somewhere],
        led=led[somewhere],
        measured=measured[somewhere],
        predicted=places.leds[pose, led][somewhere],
        nominal=nominal[view, pose, led][somewhere],
        size=rms(block.size),
        size_nominal=rms(block.size_nominal),
        outlier=np.bincount(row, block.outlier)[somewhere] > 0,
        covariance=covariance[somewhere],
    )


def _triangulated(
    pixels: Sightings, state: Snapshot, fastened: Attachments, places: Places, row: Ints, pose: Ints, view: Ints
) -> tuple[Floats, Floats]:
    """Points (M, 3) and covariances, in the base link's frame, each by the cameras that are in one frame; else NaN."""
    uv = np.full((len(pose), len(state.cameras), 2), np.nan)
    sigma = np.ones(uv.shape[:2])
    uv[row, pixels.camera], sigma[row, pixels.camera] = pixels.measured, pixels.sigma
    points, covariances = np.full((len(pose), 3), np.nan), np.full((len(pose), 3, 3), np.nan)
    for frame in np.unique(view):
        cameras = np.flatnonzero(fastened.camera == frame)
        if len(cameras) < 2:
            continue
        mine = view == frame
        first = cameras[0]
        T_cam_first = (np.eye(4), *(state.T_cam_frame[c] @ inverse(state.T_cam_frame[first]) for c in cameras[1:]))
        rig = Rig(tuple(state.cameras[c] for c in cameras), T_cam_first)
        found = rig.triangulate(uv[mine][:, cameras], sigma[mine][:, cameras])
        points[mine], covariances[mine] = _moved(places.T_base_cam[first, pose[mine]], found.points, found.covariances)
    return points, covariances


def _moved(T_a_b: Floats, points: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Points (M, 3) with covariances (M, 3, 3) by transforms (M, 4, 4)."""
    R = T_a_b[:, :3, :3]
    return (R @ points[..., None])[..., 0] + T_a_b[:, :3, 3], R @ covariances @ np.swapaxes(R, 1, 2)


def _merged(parts: list[Leds]) -> Leds:
    order = np.argsort(np.concatenate([part.pose for part in parts]), kind="stable")
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return Leds(*(np.concatenate(column)[order] for column in columns))
