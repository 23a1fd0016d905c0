"""What a calibration shows in space, as arrays in the base link's frame: LEDs, cameras, both arms, the workspace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Bools, Floats, Ints, frozen, inverse
from urdfcal.cameras.rig import Rig
from urdfcal.estimation.alignment import kabsch
from urdfcal.output import fitted
from urdfcal.output.placing import RobotPoses, dh_frames, row_corners
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from urdfcal.output.fitted import ArmEstimate, ResidualTable
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.attachments import Attachments

# Enough for a map of 20 x 20 cells; drawing more takes longer and shows the same.
_SAMPLES = 1500


@dataclass(frozen=True, eq=False)
class LedTable:
    """LEDs in space, one row for every LED and pose at which it was measured, ordered by pose.

    What fixed cameras and cameras on different links see of one LED are rows of their own.

    Attributes:
        pose: (M,) index of the pose.
        led: (M,) index of the LED.
        measured: (M, 3) triangulated, or the tracker's point, in the base link's frame. [m]
        predicted: (M, 3) by the calibrated arm. [m]
        nominal: (M, 3) by the nominal arm, relative to the calibrated one in the world, or as seen from the link that
            the camera is on. [m]
        size: (M,) of the residual after calibration, in standard deviations (rms over the LED's detections).
        size_nominal: (M,) the same for the nominal arm.
        outlier: (M,) whether one of its detections was taken out of the fit.
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
class CalibrationScene:
    """A calibration in the base link's frame, at N poses of n joints with R DH rows.

    Attributes:
        arm: the calibrated arm, LEDs and cameras.
        frames: (N, n + 1, 4, 4) base link and joint frames of the calibrated arm. [m]
        ghost: (N, n + 1, 4, 4) those of the nominal arm, their deviation from the calibrated arm enlarged. [m]
        dh: (N, R + 1, 4, 4) DH frames F_0 ... F_R of the calibrated arm. [m]
        corners: (N, R, 3, 3) where each row starts, where its common normal leaves its axis, where it ends. [m]
        views: (C, N, 4, 4) camera frames. [m]
        links: (C,) for each camera the link that it is on, None where it is fixed in the world.
        leds: where the LEDs were measured and predicted.
        tables: the measurements, each kind that there is.
        pixels: what the cameras saw, if there are any.
        rays: (S, 2, 3) for every row of ``pixels``: the camera, and the point of the detection's ray as far away as
            the predicted LED; NaN where the lens model has no ray. [m]
        factor: how many times deviations and residuals in space are enlarged.
        pixel_factor: how many times residuals of the nominal arm are enlarged in the images.
        field_factor: how many times those of the calibrated arm are.
    """

    arm: ArmEstimate
    frames: Floats
    ghost: Floats
    dh: Floats
    corners: Floats
    views: Floats
    links: tuple[str | None, ...]
    leds: LedTable
    tables: tuple[ResidualTable, ...]
    pixels: ResidualTable | None
    rays: Floats
    factor: float
    pixel_factor: float
    field_factor: float


def build_scene(calibration: FittedCalibration) -> CalibrationScene:
    """Work out where everything of a calibration is, in the base link's frame."""
    session, table = calibration.session, calibration.table
    arm = fitted.calibrated(calibration)
    poses = RobotPoses.of(session, arm, session.q)
    # The two arms are compared in what they share, the world or the link that carries the camera, seen by the same
    # cameras (wrong lenses would put the nominal arm anywhere); the calibrated base carries the view.
    other = RobotPoses.of(session, fitted.nominal(calibration, same_cameras=True), session.q)
    T_base_other = poses.T_base_frame @ inverse(other.T_base_frame)
    nominal = T_base_other[0, :, None] @ other.frames
    nominal_leds = np.einsum("fnij,nlj->fnli", T_base_other[..., :3, :3], other.leds) + T_base_other[:, :, None, :3, 3]
    tables = fitted.measurements_of(calibration)
    pixels = next((table for table in tables if table.by_camera), None)
    rays = _rays(pixels, arm, poses) if pixels else np.zeros((0, 2, 3))
    parts = [
        _bodies(block, poses)
        if block.led.min() >= len(arm.leds)
        else _leds(block, arm, session.attachments, rays, poses, nominal_leds)
        for block in tables
    ]
    leds = parts[0] if len(parts) == 1 else _merged(parts)
    apart = np.linalg.norm(nominal[..., :3, 3] - poses.frames[..., :3, 3], axis=-1).mean(axis=0).max()
    dh = dh_frames(table, arm.row_offsets, poses.frames)
    factor = magnification(max(float(apart), _typical(leds.nominal - leds.measured)), 0.1 * table.chain.reach)
    width = float(np.mean([camera.resolution[0] for camera in arm.cameras])) if pixels else 0.0
    names = session.attachments.frames
    return CalibrationScene(
        arm=arm,
        frames=poses.frames,
        ghost=exaggerated(poses.frames, nominal, factor),
        dh=dh,
        corners=row_corners(table, arm.row_offsets, poses.frames, dh),
        views=poses.T_base_cam,
        links=tuple(names[frame] if frame else None for frame in session.attachments.camera[: len(arm.cameras)]),
        leds=leds,
        tables=tables,
        pixels=pixels,
        rays=rays,
        factor=factor,
        pixel_factor=magnification(_typical(pixels.nominal - pixels.measured), 0.05 * width) if pixels else 1.0,
        field_factor=magnification(_typical(pixels.predicted - pixels.measured), 0.03 * width) if pixels else 1.0,
    )


def exaggerated(T_base_here: Floats, T_base_there: Floats, factor: float) -> Floats:
    """Go from frames towards their counterparts and ``factor`` times as far, (..., 4, 4)."""
    T: Floats = T_base_here + factor * (T_base_there - T_base_here)  # right for the translations
    for k in np.ndindex(T.shape[:-2]):
        R = T_base_here[k][:3, :3]
        T[k][:3, :3] = R @ pin.exp3(factor * pin.log3(R.T @ T_base_there[k][:3, :3]))
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


def _rays(pixels: ResidualTable, arm: ArmEstimate, poses: RobotPoses) -> Floats:
    T = poses.T_base_cam[pixels.camera, pixels.pose]
    depth = np.einsum("si,si->s", T[:, :3, 2], poses.leds[pixels.pose, pixels.led] - T[:, :3, 3])
    ray = np.empty((len(T), 3))
    for c, camera in enumerate(arm.cameras):
        ray[pixels.camera == c] = camera.unproject(pixels.measured[pixels.camera == c])
    end = T[:, :3, 3] + np.einsum("sij,sj->si", T[:, :3, :3], ray * depth[:, None])
    return np.stack([T[:, :3, 3], end], axis=1)


def _leds(
    block: ResidualTable, arm: ArmEstimate, fastened: Attachments, rays: Floats, poses: RobotPoses, nominal: Floats
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
    alone = np.isnan(measured[row]).any(axis=1)
    if alone.any():
        measured[row[alone]] = rays[alone, 1]
    somewhere = np.isfinite(measured).all(axis=1)  # not where the lens model has no ray for the pixel

    def rms(size: Floats) -> Floats:
        result: Floats = np.sqrt(np.bincount(row, size**2) / np.bincount(row))[somewhere]
        return result

    return LedTable(
        pose=pose[somewhere],
        led=led[somewhere],
        measured=measured[somewhere],
        predicted=poses.leds[pose, led][somewhere],
        nominal=nominal[view, pose, led][somewhere],
        size=rms(block.size),
        size_nominal=rms(block.size_nominal),
        outlier=np.bincount(row, block.outlier)[somewhere] > 0,
        covariance=covariance[somewhere],
    )


def _triangulated(
    pixels: ResidualTable, arm: ArmEstimate, fastened: Attachments, poses: RobotPoses, row: Ints, pose: Ints, view: Ints
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
    covariance = block.sigma[:, None, None] ** 2 * np.eye(3)
    measured, covariance = _moved(T_base_world, block.measured, covariance)
    predicted, nominal = (_moved(T_base_world, of, covariance)[0] for of in (block.predicted, block.nominal))
    own = (block.size, block.size_nominal, block.outlier)
    return LedTable(block.pose, block.led, measured, predicted, nominal, *own, covariance)


def _merged(parts: list[LedTable]) -> LedTable:
    order = np.argsort(np.concatenate([part.pose for part in parts]), kind="stable")
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return LedTable(*(np.concatenate(column)[order] for column in columns))


@dataclass(frozen=True, eq=False)
class Workspace:
    """Tip errors at joint values drawn at random within the joints' limits.

    Attributes:
        tip: (M, 3) of the calibrated arm in the base link's frame. [m]
        before: (M,) distance of the nominal arm's tip, after the best rigid alignment at the base. [m]
        after: (M,) predicted standard deviation of the calibrated tip's place, aligned likewise. [m]
        measured: (M,) whether the joint values lie in the measured domain.
    """

    tip: Floats
    before: Floats
    after: Floats
    measured: Bools

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest error before and after. [m]."""
        both = np.concatenate([self.before, self.after])
        return float(both.min()), float(both.max())


def sample_workspace(calibration: FittedCalibration) -> Workspace:
    """Sample the workspace with the calibration's own seed."""
    chain = calibration.chain
    q = chain.random_values(_SAMPLES, np.random.default_rng(calibration.seed))
    tip = tip_poses(chain, q, calibration.placements)[:, :3, 3]
    nominal = tip_poses(chain, q)[:, :3, 3]
    T = kabsch(nominal, tip)
    before = np.linalg.norm(nominal @ T[:3, :3].T + T[:3, 3] - tip, axis=1)
    measured = calibration.in_domain(chain.readings(q))
    return Workspace(frozen(tip), frozen(before), frozen(calibration.tip_sigma(q)), measured)
