"""What a recording shows besides the arm: cameras, LEDs, residuals, workspace, and texts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from urdfcal.output.chart import Scale
from urdfcal.output.fitted import nominal
from urdfcal.output.palette import (
    CALIBRATED,
    FAINT,
    INK,
    MEASURED,
    NOMINAL,
    OUTLIER,
    by_sigma,
    viridis,
)
from urdfcal.output.photographs import compressed, find_photographs
from urdfcal.output.projection import arm_in_images, finite_pieces
from urdfcal.output.stream import CORNER, placed
from urdfcal.output.texts import ELLIPSOID
from urdfcal.rotations import matrix_to_quaternion

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from urdfcal.arrays import Floats, Ints
    from urdfcal.cameras.camera import Camera
    from urdfcal.output.fitted import ResidualTable
    from urdfcal.output.scene import CalibrationScene, Workspace
    from urdfcal.output.stream import Layer
    from urdfcal.result.fitted import FittedCalibration

# rerun takes negative radii as points on the screen instead of metres.
_DOT, _SMALL_DOT, _THIN, _LINE, _ARROW = -4.0, -2.0, -0.8, -1.5, -3.0
# Below a nanometre an error is none. [m]
_SMALLEST = 1e-9


def log_cameras(base: Layer, calibration: FittedCalibration, scene: CalibrationScene) -> None:
    """Log the cameras' poses and frusta, their rays to the LEDs, their images, and the arm drawn into these."""
    photographs = find_photographs(calibration.session)
    arms = [
        (name, arm_in_images(calibration, arm, calibration.session.q), color, radius)
        for name, arm, color, radius in (
            ("nominal", nominal(calibration), NOMINAL, 2 * _LINE),
            ("calibrated", scene.arm, CALIBRATED, _THIN),
        )
    ]
    for index, camera in enumerate(scene.arm.cameras):
        image = base.at("cameras", camera.name, "image")
        _log_camera(base, index, camera, scene)
        _log_photographs(image, photographs[index])
        for name, lines, color, radius in arms:
            _log_arm(image.at("arm", name), lines[index], color, radius)


def _log_camera(base: Layer, index: int, camera: Camera, scene: CalibrationScene) -> None:
    link, views = scene.links[index], scene.views[index]
    distance = float(np.median(np.linalg.norm(scene.leds.measured - views[scene.leds.pose, :3, 3], axis=1)))
    body = base.at("cameras", camera.name)
    if link is None and np.ptp(views[:, :3], axis=0).max() == 0.0:
        body.fixed(placed(views[0]))
    else:
        body.moving(views)
    body.fixed(rr.TransformAxes3D(axis_length=0.05 * distance))
    label = camera.name if link is None else f"{camera.name}, on {link}"
    body.at("name").fixed(rr.Points3D([[0, 0, 0]], radii=_SMALL_DOT, labels=label, colors=INK))
    body.at("image").fixed(
        rr.Pinhole(
            focal_length=camera.intrinsics[:2],
            principal_point=camera.intrinsics[2:] + CORNER,
            resolution=camera.resolution,
            image_plane_distance=0.15 * distance,
            line_width=_THIN,
        )
    )
    if scene.pixels is not None:
        seen = np.flatnonzero(scene.pixels.camera == index)
        _log_image(body.at("image"), scene, scene.pixels, seen)
        seen = seen[np.isfinite(scene.rays[seen]).all(axis=(1, 2))]
        rays = base.at("rays", camera.name)
        rays.fixed(rr.LineStrips3D.from_fields(colors=FAINT, radii=_THIN))
        rays.each(rr.LineStrips3D.columns(strips=scene.rays[seen].astype(np.float32)), scene.pixels.pose[seen])
    width, height = camera.resolution
    border = [[0, 0], [width, 0], [width, height], [0, height], [0, 0]]
    body.at("image", "border").fixed(rr.LineStrips2D([border], colors=FAINT, radii=_THIN))


def _log_photographs(image: Layer, photographs: Mapping[int, Path]) -> None:
    if photographs:
        pose = np.array(sorted(photographs))
        image.fixed(rr.EncodedImage.from_fields(media_type="image/jpeg"))
        image.each(rr.EncodedImage.columns(blob=compressed(photographs[k] for k in pose)), pose)


def _log_arm(layer: Layer, uv: Floats, color: tuple[int, ...], radius: float) -> None:
    """Log the arm in a camera's image, drawn from joint values alone: (N, P, 2) px."""
    # The calibrated arm, thinner, lies on the nominal one.
    layer.fixed(rr.LineStrips2D.from_fields(colors=color, radii=radius, draw_order=10.0 + radius))
    pieces = [(pose, piece + CORNER) for pose, line in enumerate(uv) for piece in finite_pieces(line)]
    if pieces:
        strips = rr.LineStrips2D.columns(strips=[piece.astype(np.float32) for _, piece in pieces])
        layer.each(strips, np.array([pose for pose, _ in pieces]))


def _log_image(image: Layer, scene: CalibrationScene, pixels: ResidualTable, seen: Ints) -> None:
    pose = pixels.pose[seen]
    detected, predicted, expected = (uv[seen] + CORNER for uv in (pixels.measured, pixels.predicted, pixels.nominal))
    for name, places, color in (
        ("sighted", detected, MEASURED),
        ("predicted", predicted, CALIBRATED),
        ("nominal", expected, NOMINAL),
    ):
        image.at(name).fixed(rr.Points2D.from_fields(colors=color, radii=_DOT))
        image.at(name).each(rr.Points2D.columns(positions=places), pose)
    arrows = rr.Arrows2D.columns(origins=detected, vectors=scene.pixel_factor * (expected - detected))
    image.at("residual nominal").fixed(rr.Arrows2D.from_fields(colors=NOMINAL))
    image.at("residual nominal").each(arrows, pose)
    cut = pixels.outlier[seen]
    for name, factor, places, size in (
        ("field", scene.field_factor, predicted, pixels.size[seen]),
        ("field nominal", scene.pixel_factor, expected, pixels.size_nominal[seen]),
    ):
        vectors, colors = factor * (places - detected)[~cut], by_sigma(size[~cut])
        image.at(name).fixed(rr.Arrows2D(origins=detected[~cut], vectors=vectors, colors=colors, radii=_THIN))
    image.at("outliers").fixed(rr.Points2D(detected[cut], colors=OUTLIER, radii=_DOT))


def log_leds(base: Layer, scene: CalibrationScene) -> None:
    """Log where the LEDs were measured and predicted, and the enlarged residuals between them."""
    leds, factor = scene.leds, scene.factor
    for name, places, color in (
        ("measured", leds.measured, MEASURED),
        ("predicted", leds.predicted, CALIBRATED),
        ("nominal", leds.predicted + factor * (leds.nominal - leds.predicted), NOMINAL),
    ):
        base.at("led", name).fixed(rr.Points3D.from_fields(colors=color, radii=_DOT))
        base.at("led", name).each(rr.Points3D.columns(positions=places), leds.pose)
    _log_ellipsoids(base.at("led", "covariance"), scene)
    base.at("led", "all").fixed(rr.Points3D(leds.measured, colors=by_sigma(leds.size), radii=_SMALL_DOT))
    base.at("led", "outliers").fixed(rr.Points3D(leds.measured[leds.outlier], colors=OUTLIER, radii=_DOT))
    for name, places, size in (("calibrated", leds.predicted, leds.size), ("nominal", leds.nominal, leds.size_nominal)):
        vectors, colors = factor * (places - leds.measured), by_sigma(size)
        arrows = base.at("residuals", name)
        arrows.fixed(rr.Arrows3D.from_fields(radii=_ARROW))
        arrows.each(rr.Arrows3D.columns(origins=leds.measured, vectors=vectors, colors=colors), leds.pose)
    used = ~leds.outlier
    vectors = factor * (leds.predicted - leds.measured)[used]
    field = rr.Arrows3D(origins=leds.measured[used], vectors=vectors, colors=by_sigma(leds.size[used]), radii=_THIN)
    base.at("residuals", "field").fixed(field)


def _log_ellipsoids(layer: Layer, scene: CalibrationScene) -> None:
    """Log what the declared noise lets one know of each LED's place, enlarged as the residuals are."""
    leds = scene.leds
    known = np.isfinite(leds.covariance).all(axis=(1, 2))
    variances, axes = np.linalg.eigh(leds.covariance[known])
    axes[..., 0] *= np.linalg.det(axes)[:, None]  # a rotation, not a reflection
    layer.fixed(
        rr.Ellipsoids3D.from_fields(
            colors=(*MEASURED, 40), line_radii=_THIN, fill_mode=rr.components.FillMode.TransparentFillMajorWireframe
        )
    )
    columns = rr.Ellipsoids3D.columns(
        centers=leds.measured[known],
        half_sizes=ELLIPSOID * scene.factor * np.sqrt(np.maximum(variances, 0.0)),
        quaternions=matrix_to_quaternion(axes),
    )
    layer.each(columns, leds.pose[known])


def log_workspace(layer: Layer, workspace: Workspace) -> None:
    """Log the tip's places over the workspace, coloured by how far it is off, on one scale before and after.

    Where the configuration was not measured, the dot is small.
    """
    smallest, largest = workspace.range
    scale = Scale(max(smallest, _SMALLEST), max(largest, 2.0 * _SMALLEST), logarithmic=True)
    radii = np.where(workspace.measured, _DOT, _SMALL_DOT)
    for name, error in (("nominal", workspace.before), ("calibrated", workspace.after)):
        colors = viridis(scale.share(np.maximum(error, _SMALLEST)))
        layer.at(name).fixed(rr.Points3D(workspace.tip, colors=colors, radii=radii))
