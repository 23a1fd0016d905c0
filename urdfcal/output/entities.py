"""Everything that a recording shows: the arms, and here cameras, LEDs, residuals, workspace, charts and texts."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from urdfcal.arrays import evenly
from urdfcal.output import arms, palette
from urdfcal.output.chart import Chart, Scale, reference_length
from urdfcal.output.charts import (
    all_charts,
    error_colors,
    paths,
)
from urdfcal.output.findings import Overview, headline, meaning
from urdfcal.output.images import arm_in_images, find_rejected, finite_pieces
from urdfcal.output.pictures import find_pictures
from urdfcal.output.pose_texts import ELLIPSOID, pose_texts
from urdfcal.output.scene import MOST_ARROWS, image_range
from urdfcal.output.stream import CORNER, ITERATION, Layer
from urdfcal.output.texts import tab_texts
from urdfcal.rotations import matrix_to_quaternion

if TYPE_CHECKING:
    from rerun import RecordingStream

    from urdfcal.arrays import Floats, Ints
    from urdfcal.cameras.camera import Camera
    from urdfcal.output.scene import CalibrationScene, ResidualTable
    from urdfcal.output.workspace import Workspace
    from urdfcal.result.fitted import FittedCalibration

# Size of the plotted area; only its shape is seen.
_WIDTH, _HEIGHT = 150.0, 90.0
# Rows with names need so much height each, lest the names overlap; beyond the limit they had better.
_ROW, _TALLEST = 12.0, 230.0
# Of more of them than this every second or third is written.
_MOST_NAMES = 40
# Room for tick labels: numbers and names to the left, and right, above and below.
_NUMBERS, _NAMES, _RIGHT, _ABOVE, _BELOW = 24.0, 75.0, 8.0, 6.0, 18.0
_LABEL, _LABEL_OF_NAMES = 18.0, 12.0
_LETTER = 4.2
# Half the height of a label beside a chart, which is small among others, and beside one with names, which is large.
_HALF_LABEL, _HALF_NAME = 6.5, 3.5
# A bar of colours beside a chart: how far, how thick, in how many steps, and the room that it needs with its numbers.
_APART, _THICK, _STEPS, _BAR = 6.0, 5.0, 24, 32.0
# rerun takes negative radii as points on the screen instead of metres.
_DOT, _SMALL_DOT, _THIN, _LINE, _ARROW = -4.0, -2.0, -0.8, -1.5, -3.0
_HAIR, _NONE = -0.5, 0.0
_RADII = {"dots": -2.0, "lines": -0.9, "bars": -0.9, "hairlines": _HAIR}
# The viewer may hide the lowest of what is drawn over a picture behind it: that is its border, which lies at its edge.
_BORDER = 5.0
# Above all lines: what is predicted lies on what was detected.
_DOTS = 40.0
# A ring about what was detected, for the image's width, and its corners.
_RING, _ROUND = 0.012, 25


def log_overview(stream: RecordingStream, overview: Overview, entity_path: str) -> tuple[str, ...]:
    """Log what was worked out of a calibration; see ``log_calibration``."""
    calibration, scene = overview.calibration, overview.scene
    session = calibration.session
    base = Layer(stream, entity_path, len(session.q), session.time)
    base.fixed(rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.TransformAxes3D(axis_length=0.1 * session.chain.reach))
    warnings = arms.log_arms(base, session, scene)
    arms.log_dh(base.at("dh"), calibration.table, scene)
    _log_cameras(base, calibration, scene)
    _log_leds(base, scene)
    for k, of in enumerate(overview.workspaces):
        layer = base.at("workspace")
        _log_workspace(layer.at(of.link) if k else layer, of, error_colors(overview.workspaces))
    _log_residuals(base, scene)
    _log_convergence(base, calibration, scene)
    for chart in all_charts(overview):
        log_chart(base.at("charts"), chart)
    _log_texts(base, overview)
    return warnings


def _log_cameras(base: Layer, calibration: FittedCalibration, scene: CalibrationScene) -> None:
    """Log the cameras' poses and frusta, their rays to the LEDs, their images, and the arm drawn into these."""
    pictures, rejected = find_pictures(calibration.session), find_rejected(calibration.session)
    fastened = calibration.session.attachments
    told = calibration.problem.told(calibration.session.q)
    # The calibrated arm, thinner, lies on the nominal one in the space's view of the images.
    lines = [
        ("nominal", arm_in_images(calibration, calibration.nominal, told), 2 * _THIN),
        ("calibrated", arm_in_images(calibration, calibration.estimate, calibration.true_q), _THIN),
    ]
    for index, camera in enumerate(calibration.estimate.cameras):
        image = base.at("cameras", camera.name, "image")
        frame = fastened.camera[index]
        _log_camera(base, index, camera, fastened.frames[frame] if frame else None, scene)
        if pictures[index]:
            pose = np.array(sorted(pictures[index]))
            blobs = [pictures[index][k] for k in pose.tolist()]
            image.each(rr.EncodedImage, {"blob": blobs}, pose, media_type="image/jpeg")
        if lights := rejected.get(camera.name):
            pose, places = np.array([light[0] for light in lights]), [light[1:3] for light in lights]
            columns = {"positions": np.array(places) + CORNER, "labels": [light[3] for light in lights]}
            same = {"colors": palette.REJECTED, "radii": _SMALL_DOT, "show_labels": False}
            image.at("rejected").each(rr.Points2D, columns, pose, **same)
        for name, uv, radius in lines:
            pieces = [(pose, piece + CORNER) for pose, line in enumerate(uv[index]) for piece in finite_pieces(line)]
            arm, color = image.at("arm", name), palette.OF_ARM[name]
            arm.fixed(rr.LineStrips2D.from_fields(colors=color, radii=radius, draw_order=10.0 + radius))
            if pieces:
                strips = {"strips": [piece.astype(np.float32) for _, piece in pieces]}
                arm.each(rr.LineStrips2D, strips, np.array([pose for pose, _ in pieces]))


def _log_camera(base: Layer, index: int, camera: Camera, link: str | None, scene: CalibrationScene) -> None:
    views = scene.views[index]
    distance = float(np.median(np.linalg.norm(scene.leds.measured - views[scene.leds.pose, :3, 3], axis=1)))
    body = base.at("cameras", camera.name)
    log_frustum(body, camera, views, distance, link)
    if scene.pixels is not None:
        seen = np.flatnonzero(scene.pixels.camera == index)
        _log_image(body.at("image"), scene, scene.pixels, camera, seen)
        seen = seen[np.isfinite(scene.rays[seen]).all(axis=(1, 2))]
        rays = base.at("rays", camera.name)
        strips = scene.rays[seen].astype(np.float32)
        rays.each(rr.LineStrips3D, {"strips": strips}, scene.pixels.pose[seen], colors=palette.FAINT, radii=_THIN)


def log_frustum(body: Layer, camera: Camera, views: Floats, distance: float, link: str | None) -> None:
    """Log a camera, its name and what it can see.

    Args:
        body: where.
        camera: its lens.
        views: (N, 4, 4) where it is at each pose. [m]
        distance: about as far it looks. [m]
        link: that carries it; None for a standing one.
    """
    body.placed(views, moves=link is not None or np.ptp(views[:, :3], axis=0).max() > 0.0)
    body.fixed(rr.TransformAxes3D(axis_length=0.05 * distance))
    label = camera.name if link is None else f"{camera.name}, on {link}"
    body.at("name").fixed(rr.Points3D([[0, 0, 0]], radii=_SMALL_DOT, labels=label, colors=palette.INK))
    body.at("image").fixed(
        rr.Pinhole(
            focal_length=camera.intrinsics[:2],
            principal_point=camera.intrinsics[2:] + CORNER,
            resolution=camera.resolution,
            image_plane_distance=0.15 * distance,
            line_width=_THIN,
        )
    )
    width, height = camera.resolution
    border = [[0, 0], [width, 0], [width, height], [0, height], [0, 0]]
    edge = rr.LineStrips2D([border], colors=palette.FAINT, radii=_THIN, draw_order=_BORDER)
    body.at("image", "border").fixed(edge)


def _log_image(image: Layer, scene: CalibrationScene, pixels: ResidualTable, camera: Camera, seen: Ints) -> None:
    pose = pixels.pose[seen]
    detected, predicted, expected = (uv[seen] + CORNER for uv in (pixels.measured, pixels.predicted, pixels.nominal))
    for above, (name, places, color) in enumerate(
        (
            ("sighted", detected, palette.MEASURED),
            ("nominal", expected, palette.NOMINAL),
            ("predicted", predicted, palette.CALIBRATED),
        )
    ):
        # Small: what was detected is to be seen below. A ring shows where it is.
        dots = {"colors": color, "radii": _SMALL_DOT, "draw_order": _DOTS + above}
        image.at(name).each(rr.Points2D, {"positions": places}, pose, **dots)
    width = float(np.ptp(image_range(camera.resolution, pixels.measured[seen])[0]))
    angle = np.linspace(0.0, 2.0 * np.pi, _ROUND)
    ring = _RING * width * np.column_stack([np.cos(angle), np.sin(angle)])
    rings = {"strips": (detected[:, None] + ring).astype(np.float32)}
    image.at("ring").each(rr.LineStrips2D, rings, pose, colors=palette.MEASURED, radii=_THIN)
    arrows = {"origins": detected, "vectors": scene.pixel_factor * (expected - detected)}
    image.at("residual nominal").each(rr.Arrows2D, arrows, pose, colors=palette.NOMINAL)
    cut = pixels.outlier[seen]
    some = evenly(np.flatnonzero(~cut), MOST_ARROWS)
    for name, factor, places, size in (
        ("field", scene.pixel_factor, predicted, pixels.size[seen]),
        ("field enlarged", scene.field_factor, predicted, pixels.size[seen]),
        ("field nominal", scene.pixel_factor, expected, pixels.size_nominal[seen]),
    ):
        vectors, colors = factor * (places - detected)[some], palette.by_sigma(size[some])
        image.at(name).fixed(rr.Arrows2D(origins=detected[some], vectors=vectors, colors=colors, radii=_THIN))
    image.at("outliers").fixed(rr.Points2D(detected[cut], colors=palette.OUTLIER, radii=_SMALL_DOT))
    # Arrows of known lengths, for both enlargements.
    for name, factor in (("scale", scene.pixel_factor), ("scale enlarged", scene.field_factor)):
        length = reference_length(0.15 * width / factor)
        corner = np.array([[0.03 * width, 0.9 * camera.resolution[1]]])
        known = rr.Arrows2D(origins=corner, vectors=[[factor * length, 0.0]], labels=f"{length:g} px", radii=_THIN,
                            colors=palette.MEASURED, show_labels=True)  # fmt: skip
        image.at(name).fixed(known)


def _log_leds(base: Layer, scene: CalibrationScene) -> None:
    """Log where the LEDs were measured and predicted, and the enlarged residuals between them."""
    leds, factor = scene.leds, scene.factor
    for name, places, color in (
        ("measured", leds.measured, palette.MEASURED),
        ("predicted", leds.predicted, palette.CALIBRATED),
        ("nominal", leds.predicted + factor * (leds.nominal - leds.predicted), palette.NOMINAL),
    ):
        base.at("led", name).each(rr.Points3D, {"positions": places}, leds.pose, colors=color, radii=_DOT)
    # What the declared noise lets one know of each LED's place, enlarged as the residuals are.
    known = np.isfinite(leds.covariance).all(axis=(1, 2))
    variances, axes = np.linalg.eigh(leds.covariance[known])
    axes[..., 0] *= np.linalg.det(axes)[:, None]  # a rotation, not a reflection
    ellipsoids = {
        "centers": leds.measured[known],
        "half_sizes": ELLIPSOID * factor * np.sqrt(np.maximum(variances, 0.0)),
        "quaternions": matrix_to_quaternion(axes),
    }
    fill = rr.components.FillMode.TransparentFillMajorWireframe
    base.at("led", "covariance").each(
        rr.Ellipsoids3D, ellipsoids, leds.pose[known], colors=(*palette.MEASURED, 40), line_radii=_THIN, fill_mode=fill
    )
    base.at("led", "all").fixed(rr.Points3D(leds.measured, colors=palette.by_sigma(leds.size), radii=_SMALL_DOT))
    base.at("led", "outliers").fixed(rr.Points3D(leds.measured[leds.outlier], colors=palette.OUTLIER, radii=_DOT))
    for name, places, size in (("calibrated", leds.predicted, leds.size), ("nominal", leds.nominal, leds.size_nominal)):
        vectors = factor * (places - leds.measured)
        arrows = {"origins": leds.measured, "vectors": vectors, "colors": palette.by_sigma(size)}
        base.at("residuals", name).each(rr.Arrows3D, arrows, leds.pose, radii=_ARROW)
    used = evenly(np.flatnonzero(~leds.outlier), MOST_ARROWS)
    vectors = factor * (leds.predicted - leds.measured)[used]
    colors = palette.by_sigma(leds.size[used])
    field = rr.Arrows3D(origins=leds.measured[used], vectors=vectors, colors=colors, radii=_THIN)
    base.at("residuals", "field").fixed(field)


def _log_workspace(layer: Layer, workspace: Workspace, scale: Scale) -> None:
    """Log the tip's places over the workspace, coloured by how far it is off, on one scale before and after.

    Where the configuration was not measured, the dot is small.
    """
    radii = np.where(workspace.measured, _DOT, _SMALL_DOT)
    for name, error in workspace.errors.items():
        colors = palette.viridis(np.clip(scale.share(1e3 * error), 0.0, 1.0))
        layer.at(name).fixed(rr.Points3D(workspace.tip, colors=colors, radii=radii))


def _log_residuals(base: Layer, scene: CalibrationScene) -> None:
    """Log the rms residual of every pose, nominal and calibrated, in px or mm, without outliers."""
    for table in scene.tables:
        for name, predicted in table.by_arm.items():
            pose, rms = table.rms_by(table.pose, predicted)
            plot = base.at("plots", f"residual_{table.unit}", name)
            plot.fixed(rr.SeriesLines(colors=palette.OF_ARM[name], names=f"{name} [{table.unit}]", widths=1.5))
            plot.each(rr.Scalars, {"scalars": rms}, pose)


def _log_convergence(base: Layer, calibration: FittedCalibration, scene: CalibrationScene) -> None:
    """Log cost, damping, step, the rms residual (from the nominal arm's on) and every parameter, step by step.

    A parameter comes with its final value minus and plus one standard deviation. [mm, mrad]
    """
    plots, problem = base.at("plots"), calibration.problem
    for name in ("cost", "damping", "step"):
        _log_iterations(plots.at(name), 1, np.array([getattr(step, name) for step in calibration.fit.history]))
    for block, outlier, table in zip(calibration.observations, calibration.fit.outlier, scene.tables, strict=True):
        used = block.valid & ~outlier
        residuals = (problem.residual(block, state)[used] for state in calibration.states)
        rms = table.scale * np.sqrt([np.mean(np.sum(r**2, axis=1)) for r in residuals])
        _log_iterations(plots.at(f"rms_{table.unit}"), 0, rms)
    way, sigmas = paths(calibration), 1e3 * calibration.sigmas()
    for i, k in np.argwhere(np.isfinite(sigmas)):
        joint, name = calibration.geometry.labels[i], calibration.geometry.columns[k]
        band = np.repeat([way[-1, i, k] + sigmas[i, k] * np.array([-1.0, 1.0])], len(way), axis=0)
        series = rr.SeriesLines(
            colors=[palette.PARAMETER_COLORS[name]] * 3,
            widths=[2.0, 0.7, 0.7],
            names=[name, f"{name} - sigma", f"{name} + sigma"],
        )
        _log_iterations(plots.at("parameters", joint, name), 0, np.column_stack([way[:, i, k], band]), series)


def _log_iterations(plot: Layer, first: int, values: Floats, series: rr.SeriesLines | None = None) -> None:
    plot.fixed(series or rr.SeriesLines(colors=palette.CALIBRATED))
    rows = rr.TimeColumn(ITERATION, sequence=np.arange(first, first + len(values)))
    columns = rr.Scalars.columns(scalars=values.ravel())
    if values.ndim == 2:
        columns = columns.partition([values.shape[1]] * len(values))
    rr.send_columns(plot.path, [rows], columns, recording=plot.stream)


def chart_view(chart: Chart, root: str) -> rrb.View:
    """The view of a chart in a recording whose base link is ``root``."""
    beside, height = _room(chart)
    right = _WIDTH + (_BAR if chart.colors else _RIGHT)
    below = height + _BELOW + (_apart(chart) if chart.x_label else 0.0)
    return rrb.Spatial2DView(
        origin=f"{root}/charts/{rr.escape_entity_path_part(chart.name)}",
        name=chart.title,
        visual_bounds=rrb.VisualBounds2D(x_range=[-beside, right], y_range=[-_ABOVE, below]),
        background=palette.BACKGROUND,
    )


def log_chart(parent: Layer, chart: Chart) -> None:
    """Draw a chart at a child of ``parent``."""
    layer, (beside, height) = parent.at(chart.name), _room(chart)
    x, y = chart.ticks(_WIDTH, height)
    grid = [[[0.0, v], [_WIDTH, v]] for v in y]
    layer.at("grid").fixed(rr.LineStrips2D(grid, colors=palette.GRID, radii=_HAIR, draw_order=-1.0))
    frame = [[0.0, 0.0], [0.0, height], [_WIDTH, height]]
    layer.at("frame").fixed(rr.LineStrips2D([frame], colors=palette.FAINT, radii=_HAIR))
    # rerun writes labels centred below their points.
    y = dict(list(y.items())[:: 1 + (len(y) - 1) // _MOST_NAMES if chart.y.names else 1])
    half = _HALF_NAME if chart.y.names else _HALF_LABEL
    ticks = [*([u, height] for u in x), *([-beside / 2, v - half] for v in y)]
    names = [*x.values(), *y.values()]
    if chart.x_label:
        ticks, names = [*ticks, [_WIDTH / 2, height + _apart(chart)]], [*names, chart.x_label]
    if chart.colors:
        share = np.linspace(1.0, 0.0, _STEPS)
        ends = np.linspace(0.0, height, _STEPS + 1)
        strips = [[[_WIDTH + _APART, a], [_WIDTH + _APART, b]] for a, b in pairwise(ends.tolist())]
        bar = rr.LineStrips2D(strips, colors=palette.viridis(share), radii=_THICK / 2, draw_order=-1.0)
        layer.at("colours").fixed(bar)
        values = chart.colors.ticks()
        place = height * (1.0 - chart.colors.share(list(values)))
        ticks += [[_WIDTH + _APART + 0.4 * _BAR, v - _HALF_LABEL] for v in place.tolist()]
        names += values.values()
    layer.at("ticks").fixed(rr.Points2D(ticks, radii=_NONE, labels=names, colors=palette.INK, show_labels=True))
    for order, mark in enumerate(chart.marks):
        shapes, colors = chart.shapes(mark, _WIDTH, height)
        kind: Any = rr.Points2D if mark.kind == "dots" else rr.LineStrips2D
        layer.at(mark.name).fixed(kind(shapes, radii=_RADII[mark.kind], colors=colors, draw_order=float(order)))


def _apart(chart: Chart) -> float:
    """How far below the axis its label is: text has one size, charts of names are drawn larger than others."""
    return _LABEL if chart.y.names is None else _LABEL_OF_NAMES


def _room(chart: Chart) -> tuple[float, float]:
    """The width of the names beside a chart, and its height."""
    longest = max(map(len, chart.y.ticks().values()), default=0)
    if chart.y.names is None:
        return max(_NUMBERS, 10.0 + _LETTER * longest), _HEIGHT
    return max(_NAMES, _LETTER * longest), max(_HEIGHT, min(_ROW * len(chart.y.names), _TALLEST))


def _log_texts(base: Layer, overview: Overview) -> None:
    """Log the verdict, what there is to see at each pose, the table of the DH rows, and the poses' names."""
    session = overview.calibration.session
    banner = f"{overview.calibration.assessment.sentence}   {headline(overview.document)}, {meaning(overview.document)}"
    base.at("banner").fixed(rr.Points2D([[0.0, 0.0]], radii=0.0, labels=banner, show_labels=False))
    texts = base.at("texts")
    texts.at("about").each(rr.TextDocument, {"text": pose_texts(overview)}, media_type=rr.MediaType.MARKDOWN)
    for name, text in tab_texts(overview).items():
        texts.at(name).fixed(rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
    texts.at("poses").fixed(rr.AnyValues(poses=session.poses))
