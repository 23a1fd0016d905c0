"""What a calibration shows, as arrays: its residuals, and LEDs, cameras and both arms in the base link's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, inverse
from urdfcal.cameras.rig import Rig
from urdfcal.estimation.alignment import kabsch
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.whitening import joint_noise
from urdfcal.output.placing import PlacedRows, RobotPoses
from urdfcal.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

if TYPE_CHECKING:
    from urdfcal.estimation.snapshot import Snapshot
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.attachments import Attachments

MOST_ARROWS = 500
"""Residuals over one image, or in space: thousands of frames of a moving arm would hide each other."""
# Base and LEDs that differ from the calibrated ones by so many times what the arms do have gone astray together.
_ASTRAY = 5.0


@dataclass(frozen=True, eq=False)
class Residuals:
    """What was measured, one row each, ordered by pose, and what both arms predict.

    Attributes:
        pose: (S,) index of the pose.
        led: (S,) index of the LED, or behind all of them of the target.
        measured: (S, D) in px of the camera, m in the world, or the kind's own unit.
        predicted: (S, D) by the calibrated arm.
        nominal: (S, D) by the nominal arm.
        size: (S,) rms of the whitened residual's components after calibration: about 1 where the noise is as declared.
        size_nominal: (S,) the same for the nominal arm.
        outlier: (S,) whether it was taken out of the fit.
    """

    pose: Ints
    led: Ints
    measured: Floats
    predicted: Floats
    nominal: Floats
    size: Floats
    size_nominal: Floats
    outlier: Bools

    @property
    def used(self) -> Bools:
        """(S,) whether it took part in the fit."""
        return ~self.outlier

    @property
    def by_arm(self) -> dict[str, Floats]:
        """(S, D) by the nominal and by the calibrated arm."""
        return {"nominal": self.nominal, "calibrated": self.predicted}


@dataclass(frozen=True, eq=False)
class ResidualTable(Residuals):
    """Measurements of one kind and their residuals, points in the world.

    Attributes:
        unit: of residuals: px for pixels, mm for points.
        scale: what residuals are multiplied by to be in that unit.
        components: the name of each component.
        by_camera: whether cameras measured.
        in_world: whether the numbers are a position in the world.
        camera: (S,) index of the camera; -1 for points.
        sigma: (S,) standard deviation of each component, by the measurement alone.
        spread: (S, D) the same with the noise of the joint readings, as the estimate weighs it.
    """

    unit: str
    scale: float
    components: tuple[str, ...]
    by_camera: bool
    in_world: bool
    camera: Ints
    sigma: Floats
    spread: Floats

    @property
    def noise(self) -> float:
        """The declared noise as the rms length of a residual, in ``unit``."""
        return float(self.scale * np.median(np.linalg.norm(self.spread, axis=1)))

    def sigmas(self, predicted: Floats) -> Floats:
        """Residuals (used, D) of a prediction (S, D) in units of the declared noise, outliers left out."""
        return ((predicted - self.measured) / self.spread)[self.used]

    def rms_by(self, index: Ints, predicted: Floats) -> tuple[Ints, Floats]:
        """The indices (of poses, of cameras) that have residuals, and their root mean square length in ``unit``.

        Args:
            index: (S,) of each row.
            predicted: (S, D) by one of the arms.
        """
        square = np.sum((self.scale * (predicted - self.measured)[self.used]) ** 2, axis=1)
        count = np.bincount(index[self.used])
        found = np.flatnonzero(count)
        return found, np.sqrt(np.bincount(index[self.used], square)[found] / count[found])


def measurements_of(calibration: FittedCalibration) -> tuple[ResidualTable, ...]:
    """Bring the calibration's blocks of observations, and what became of them, into tables."""
    fit, tables, problem = calibration.fit, [], calibration.problem
    for index, block in enumerate(calibration.observations):
        rows, (unit, scale), lengths = block.valid, block.table.report, block.table.lengths
        measured = problem.seen(block, fit.state)[rows]
        bodies = len(calibration.session.led_names) + block.index.get("target", block.row)
        size, size_nominal = (
            solution.norms[index][rows] / np.sqrt(block.dimension) for solution in (fit, calibration.nominal_fit)
        )
        at = Tangent.at(problem, block, fit.state, fit.parameters).linearise()
        joint = joint_noise(at, problem.mechanism.reading_jacobian, problem.joint_sigma)
        variance = np.sum(joint.reshape(*block.value.shape, -1) ** 2, axis=-1)
        variance += np.diagonal(block.covariance, axis1=-2, axis2=-1)
        tables.append(
            ResidualTable(
                unit=unit,
                scale=scale,
                components=block.table.components(),
                by_camera="camera" in block.index,
                in_world="camera" not in block.index and measured.shape[1] == 3,
                pose=np.broadcast_to(block.pose[:, None], rows.shape)[rows],
                led=block.index.get("led", bodies)[rows],
                camera=block.index.get("camera", np.full_like(block.row, -1))[rows],
                measured=measured,
                sigma=np.sqrt(block.covariance[rows][:, 0, 0]),
                spread=np.sqrt(variance[rows][:, lengths]),
                predicted=measured + problem.residual(block, fit.state)[rows][:, lengths],
                nominal=measured + problem.residual(block, calibration.nominal_fit.state)[rows][:, lengths],
                size=size,
                size_nominal=size_nominal,
                outlier=fit.outlier[index][rows],
            )
        )
    return tuple(tables)


@dataclass(frozen=True, eq=False)
class LedTable(Residuals):
    """LEDs in space, one row for every LED and pose at which it was measured, in the base link's frame. [m].

    What fixed cameras and cameras on different links see of one LED are rows of their own. Points are triangulated, or
    the tracker's; the nominal arm is relative to the calibrated one in the world, or as seen from the link that the
    camera is on. Sizes are the rms over the LED's detections; an outlier has one of them taken out of the fit.

    Attributes:
        covariance: (S, 3, 3) of the measurement, by the declared noise; NaN where a single camera saw it. [m2]
        ray: (S, 3) direction from that single camera, along which nothing was measured; zero of all others.
    """

    covariance: Floats
    ray: Floats


@dataclass(frozen=True, eq=False)
class CalibrationScene:
    """A calibration in the base link's frame, at N poses of n joints.

    Attributes:
        frames: (N, n + 1, 4, 4) base link and joint frames of the calibrated arm. [m]
        ghost: (N, n + 1, 4, 4) those of the nominal arm, their deviation from the calibrated arm enlarged. [m]
        rows: the DH rows of the calibrated arm.
        views: (C, N, 4, 4) camera frames. [m]
        leds: where the LEDs were measured and predicted.
        tables: the measurements, each kind that there is.
        pixels: what the cameras saw, if there are any.
        rays: (S, 2, 3) for every row of ``pixels``: the camera, and the point of the detection's ray as far away as
            the predicted LED; NaN where the lens model has no ray. [m]
        factor: how many times deviations and residuals in space are enlarged.
        pixel_factor: how many times residuals of the nominal arm are enlarged in the images.
        field_factor: how many times those of the calibrated arm are.
        apart: how far LEDs or cameras lie from the calibrated ones on the nominal arm's links where that is far more
            than the arms differ by: its base is as far off then, and the ghost is laid over the calibrated arm; 0 of
            other calibrations. [m]
    """

    frames: Floats
    ghost: Floats
    rows: PlacedRows
    views: Floats
    leds: LedTable
    tables: tuple[ResidualTable, ...]
    pixels: ResidualTable | None
    rays: Floats
    factor: float
    pixel_factor: float
    field_factor: float
    apart: float


def build_scene(calibration: FittedCalibration) -> CalibrationScene:
    """Work out where everything of a calibration is, in the base link's frame."""
    session, arm = calibration.session, calibration.estimate
    poses = RobotPoses.of(calibration, arm, calibration.true_q)
    # The two arms are compared in what they share, the world or the link that carries the camera, seen by the same
    # cameras (wrong lenses would put the nominal arm anywhere); the calibrated base carries the view.
    nominal_arm = calibration.snapshot(calibration.comparison.nominal_arm.fit.state)
    other = RobotPoses.of(calibration, nominal_arm, calibration.problem.told(session.q))
    T_base_other = poses.T_base_frame @ inverse(other.T_base_frame)
    nominal = T_base_other[0, :, None] @ other.frames
    nominal_leds = np.einsum("fnij,nlj->fnli", T_base_other[..., :3, :3], other.leds) + T_base_other[:, :, None, :3, 3]
    tables = measurements_of(calibration)
    pixels = next((table for table in tables if table.by_camera), None)
    rays = _rays(pixels, arm, poses) if pixels else np.zeros((0, 2, 3))
    parts = [
        _bodies(block, poses)
        if block.led.min() >= len(arm.leds)
        else _leds(block, arm, session.attachments, rays, poses, nominal_leds)
        for block in tables
    ]
    columns = [np.concatenate(column) for column in zip(*(vars(part).values() for part in parts), strict=True)]
    order = np.argsort(columns[0], kind="stable")
    order = order[np.isfinite(columns[2][order]).all(axis=1)]  # not where the lens model has no ray for the pixel
    leds = LedTable(*(column[order] for column in columns))
    over = _laid_over(other.frames, poses.frames)
    on_links = _moved_on_links(calibration, nominal_arm)
    apart = on_links if on_links > _ASTRAY * _deviation(over, poses.frames) else 0.0
    nominal = over if apart else nominal
    factor = magnification(
        max(_deviation(nominal, poses.frames), _typical(leds.nominal - leds.measured)), 0.1 * calibration.chain.reach
    )
    width = float(np.mean([camera.resolution[0] for camera in arm.cameras])) if pixels else 0.0
    return CalibrationScene(
        frames=poses.frames,
        ghost=exaggerated(poses.frames, nominal, factor),
        rows=poses.rows,
        views=poses.T_base_cam,
        leds=leds,
        tables=tables,
        pixels=pixels,
        rays=rays,
        factor=factor,
        pixel_factor=magnification(_typical(pixels.nominal - pixels.measured), 0.05 * width) if pixels else 1.0,
        field_factor=magnification(_typical(pixels.predicted - pixels.measured), 0.03 * width) if pixels else 1.0,
        apart=apart,
    )


def _laid_over(frames: Floats, onto: Floats) -> Floats:
    """Frames of an arm (N, K, 4, 4), moved as one to where their origins lie nearest to another arm's."""
    result: Floats = kabsch(*(of[..., :3, 3].reshape(-1, 3) for of in (frames, onto))) @ frames
    return result


def _deviation(frames: Floats, others: Floats) -> float:
    """How far the frame of two arms (N, K, 4, 4) that differs most lies apart, in the mean of all poses. [m]."""
    return float(np.linalg.norm(frames[..., :3, 3] - others[..., :3, 3], axis=-1).mean(axis=0).max())


def _moved_on_links(calibration: FittedCalibration, other: Snapshot) -> float:
    """How far LEDs, targets and cameras lie on their links from where another estimate has them, at most. [m]."""
    arm, fastened = calibration.estimate, calibration.session.attachments
    moved = [(arm.leds - other.leds)[fastened.led[: len(arm.leds)] != 0]]
    for mine, others, frames in (
        (arm.targets, other.targets, [carrier for _, carrier in fastened.carried]),
        ([*map(inverse, arm.T_cam_frame)], [*map(inverse, other.T_cam_frame)], fastened.camera),
    ):
        moved += [(T - T_other)[None, :3, 3] for T, T_other, frame in zip(mine, others, frames, strict=False) if frame]
    return float(np.linalg.norm(np.concatenate(moved), axis=1).max(initial=0.0))


def exaggerated(T_base_here: Floats, T_base_there: Floats, factor: float) -> Floats:
    """Go from frames towards their counterparts and ``factor`` times as far, (..., 4, 4)."""
    T: Floats = T_base_here + factor * (T_base_there - T_base_here)  # right for the translations
    R, R_there = T_base_here[..., :3, :3], T_base_there[..., :3, :3]
    turn = matrix_to_rotation_vector(np.swapaxes(R, -1, -2) @ R_there)
    T[..., :3, :3] = R @ rotation_vector_to_matrix(factor * turn)
    return T


def magnification(length: float, target: float) -> float:
    """The factor 1, 2, 5, 10 ... 1000 that draws a length at most as long as ``target``."""
    steps = np.outer(10.0 ** np.arange(4), [1, 2, 5]).ravel()[:10]
    return float(steps[np.searchsorted(steps[1:], target / length)]) if length > 0 else 1.0


def image_range(resolution: tuple[int, int], seen: Floats) -> tuple[tuple[float, float], tuple[float, float]]:
    """The range of u and of v that holds a camera's image and all detections (S, 2), even those that lie outside."""
    corners = np.concatenate([[[0, 0], resolution], seen])
    (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
    margin = 0.01 * max(resolution)
    return (float(left - margin), float(right + margin)), (float(top - margin), float(bottom + margin))


def _typical(vectors: Floats) -> float:
    """Median length of vectors (S, D), those that could not be predicted left out."""
    return float(np.nanmedian(np.linalg.norm(vectors, axis=-1)))


def _rays(pixels: ResidualTable, arm: Snapshot, poses: RobotPoses) -> Floats:
    T = poses.T_base_cam[pixels.camera, pixels.pose]
    depth = np.einsum("si,si->s", T[:, :3, 2], poses.leds[pixels.pose, pixels.led] - T[:, :3, 3])
    ray = np.empty((len(T), 3))
    for c, camera in enumerate(arm.cameras):
        ray[pixels.camera == c] = camera.unproject(pixels.measured[pixels.camera == c])
    end = T[:, :3, 3] + np.einsum("sij,sj->si", T[:, :3, :3], ray * depth[:, None])
    return np.stack([T[:, :3, 3], end], axis=1)


def _leds(
    block: ResidualTable, arm: Snapshot, fastened: Attachments, rays: Floats, poses: RobotPoses, nominal: Floats
) -> LedTable:
    """Gather detections of an LED at a pose; nominal LEDs (F, N, L, 3) as seen from each frame that cameras are in."""
    view = fastened.camera[block.camera] if block.by_camera else np.zeros_like(block.camera)
    shape = (len(poses.frames), len(arm.leds), len(poses.T_base_frame))
    keys, row = np.unique(np.ravel_multi_index((block.pose, block.led, view), shape), return_inverse=True)
    pose, led, view = np.unravel_index(keys, shape)
    # A tracker measures every LED once a pose: the keys are in its table's order.
    if block.in_world:
        T_base_world = poses.T_base_frame[0, pose]
        measured, covariance = _moved(T_base_world, block.measured, block.sigma[:, None, None] ** 2 * np.eye(3))
    elif block.by_camera:
        measured, covariance = _triangulated(block, arm, fastened, poses, row, pose, view)
    else:  # what was measured does not say where the LED was: it is shown where it is predicted
        measured, covariance = poses.leds[pose, led], np.zeros((len(pose), 3, 3))
    # Where a single camera sees an LED there is no distance: its ray is taken at the predicted distance.
    alone, ray = np.isnan(measured[row]).any(axis=1), np.zeros((len(pose), 3))
    if alone.any():
        measured[row[alone]], along = rays[alone, 1], rays[alone, 1] - rays[alone, 0]
        ray[row[alone]] = along / np.linalg.norm(along, axis=1, keepdims=True)
    size, size_nominal = (
        np.sqrt(np.bincount(row, of**2) / np.bincount(row)) for of in (block.size, block.size_nominal)
    )
    return LedTable(
        pose=pose,
        led=led,
        measured=measured,
        predicted=poses.leds[pose, led],
        nominal=nominal[view, pose, led],
        size=size,
        size_nominal=size_nominal,
        outlier=np.bincount(row, block.outlier) > 0,
        covariance=covariance,
        ray=ray,
    )


def _triangulated(
    pixels: ResidualTable, arm: Snapshot, fastened: Attachments, poses: RobotPoses, row: Ints, pose: Ints, view: Ints
) -> tuple[Floats, Floats]:
    """Points (M, 3) and covariances, in the base link's frame, each by the cameras that are in one frame; else NaN."""
    uv = np.full((len(pose), len(arm.cameras), 2), np.nan)
    sigma = np.ones(uv.shape[:2])
    uv[row, pixels.camera], sigma[row, pixels.camera] = pixels.measured, pixels.sigma
    points, covariances = np.full((len(pose), 3), np.nan), np.full((len(pose), 3, 3), np.nan)
    for frame in np.unique(view):
        cameras = np.flatnonzero(fastened.camera == frame)
        if len(cameras) < 2:
            continue
        mine = view == frame
        first = cameras[0]
        T_cam_first = (np.eye(4), *(arm.T_cam_frame[c] @ inverse(arm.T_cam_frame[first]) for c in cameras[1:]))
        rig = Rig(tuple(arm.cameras[c] for c in cameras), T_cam_first)
        found = rig.triangulate(uv[mine][:, cameras], sigma[mine][:, cameras])
        T_base_first = poses.T_base_frame[frame, pose[mine]] @ inverse(arm.T_cam_frame[first])
        points[mine], covariances[mine] = _moved(T_base_first, found.points, found.covariances)
    return points, covariances


def _moved(T_a_b: Floats, points: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Points (M, 3) with covariances (M, 3, 3) by transforms (M, 4, 4)."""
    R = T_a_b[:, :3, :3]
    return (R @ points[..., None])[..., 0] + T_a_b[:, :3, 3], R @ covariances @ np.swapaxes(R, 1, 2)


def _bodies(block: ResidualTable, poses: RobotPoses) -> LedTable:
    """Show the origins of targets whose poses were measured as LEDs are."""
    T_base_world = poses.T_base_frame[0, block.pose]
    measured, covariance = _moved(T_base_world, block.measured, block.sigma[:, None, None] ** 2 * np.eye(3))
    predicted, nominal = (_moved(T_base_world, of, covariance)[0] for of in (block.predicted, block.nominal))
    own = (block.size, block.size_nominal, block.outlier)
    return LedTable(block.pose, block.led, measured, predicted, nominal, *own, covariance, np.zeros_like(measured))
