"""What a recording shows besides the arm: cameras, LEDs, residuals, plots, and a legend."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from urdfcal.output.palette import CALIBRATED, FAINT, MEASURED, NOMINAL, OUTLIER, SIGMA_LEGEND, by_sigma
from urdfcal.output.stream import placed

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.output.scene import Scene, Sightings
    from urdfcal.output.stream import Layer
    from urdfcal.vision.camera import Camera

# rerun takes negative radii as points on the screen instead of metres.
_DOT, _SMALL_DOT, _THIN, _ARROW = -4.0, -2.0, -0.8, -3.0


def log_camera(base: Layer, index: int, camera: Camera, scene: Scene) -> None:
    """Log a camera's place and frustum, its rays to the LEDs, and what is in its pictures."""
    T = scene.T_base_cam[index]
    distance = float(np.median(np.linalg.norm(scene.leds.measured - T[:3, 3], axis=1)))
    body = base.at("cameras", camera.name)
    body.fixed(placed(T), rr.TransformAxes3D(axis_length=0.05 * distance))
    body.at("name").fixed(rr.Points3D([[0, 0, 0]], radii=_SMALL_DOT, labels=camera.name, colors=MEASURED))
    body.at("image").fixed(
        rr.Pinhole(
            focal_length=camera.intrinsics[:2],
            principal_point=camera.intrinsics[2:],
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


def _log_image(image: Layer, scene: Scene, pixels: Sightings, seen: Ints) -> None:
    pose, sighted = pixels.pose[seen], pixels.measured[seen]
    predicted, nominal, colors = pixels.predicted[seen], pixels.nominal[seen], by_sigma(pixels.size[seen])
    for name, places, color in (
        ("sighted", sighted, MEASURED),
        ("predicted", predicted, CALIBRATED),
        ("nominal", nominal, NOMINAL),
    ):
        image.at(name).fixed(rr.Points2D.from_fields(colors=color, radii=_DOT))
        image.at(name).each(rr.Points2D.columns(positions=places), pose)
    arrows = rr.Arrows2D.columns(origins=sighted, vectors=scene.pixel_factor * (nominal - sighted))
    image.at("residual nominal").fixed(rr.Arrows2D.from_fields(colors=NOMINAL))
    image.at("residual nominal").each(arrows, pose)
    cut = pixels.outlier[seen]
    vectors = scene.field_factor * (predicted - sighted)[~cut]
    image.at("field").fixed(rr.Arrows2D(origins=sighted[~cut], vectors=vectors, colors=colors[~cut]))
    image.at("outliers").fixed(rr.Points2D(sighted[cut], colors=OUTLIER, radii=_DOT))


def log_leds(base: Layer, scene: Scene) -> None:
    """Log where the LEDs were measured and predicted, and the enlarged residuals between them."""
    leds, factor = scene.leds, scene.factor
    for name, places, color in (
        ("measured", leds.measured, MEASURED),
        ("predicted", leds.predicted, CALIBRATED),
        ("nominal", leds.predicted + factor * (leds.nominal - leds.predicted), NOMINAL),
    ):
        base.at("led", name).fixed(rr.Points3D.from_fields(colors=color, radii=_DOT))
        base.at("led", name).each(rr.Points3D.columns(positions=places), leds.pose)
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


def log_about(base: Layer, scene: Scene, poses: tuple[str, ...], names: tuple[str, ...]) -> None:
    """Log what there is to see at each pose: its residuals in space, and what colours and enlarged things mean."""
    leds = scene.leds
    new, old = (_millimetres(places - leds.measured) for places in (leds.predicted, leds.nominal))
    lines: list[list[str]] = [[] for _ in poses]
    for m, (pose, led, cut) in enumerate(zip(leds.pose, leds.led, leds.outlier, strict=True)):
        taken_out = ", taken out of the fit" if cut else ""
        lines[pose].append(f"{names[led]} {new[m]:.2f} mm off, nominal {old[m]:.2f} mm{taken_out}")
    legend = _LEGEND.format(factor=scene.factor)
    texts = [
        f"**Pose {pose}**: {'; '.join(line) or 'nothing seen'}.\n\n{legend}"
        for pose, line in zip(poses, lines, strict=True)
    ]
    about = base.at("about")
    about.fixed(rr.TextDocument.from_fields(media_type=rr.MediaType.MARKDOWN))
    about.each(rr.TextDocument.columns(text=texts))


_LEGEND = f"""\
Solid arm: **calibrated**. Blue ghost: **nominal**, as drawn in the URDF, placed to fit the sightings best. Its
deviation and the residual arrows are enlarged **{{factor:g}} times**.

LED: white as measured, green by the calibrated arm, blue by the nominal one. Arrows from measured to predicted:
{SIGMA_LEGEND}. Purple: taken out of the fit.
"""


def _millimetres(vectors: Floats) -> Floats:
    lengths: Floats = 1e3 * np.linalg.norm(vectors, axis=1)
    return lengths
