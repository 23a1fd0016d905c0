"""The report's figures: which charts they hold, and those charts that the recording has views of its own for."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import evenly
from urdfcal.estimation.projection import projection_sigma
from urdfcal.output import palette
from urdfcal.output.chart import Chart, Mark, Scale, reference_length
from urdfcal.output.charts import (
    by_pose,
    convergence_charts,
    frame_times,
    parameter_charts,
    spread,
    workspace_charts,
)
from urdfcal.output.joint_charts import contribution_chart, joint_model_charts
from urdfcal.output.scene import MOST_ARROWS, image_range
from urdfcal.output.stream import CORNER
from urdfcal.output.svg import Figure
from urdfcal.output.workspace import MOVED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from urdfcal.arrays import Bools, Floats
    from urdfcal.cameras.camera import Camera
    from urdfcal.output.findings import Overview
    from urdfcal.output.scene import CalibrationScene, ResidualTable
    from urdfcal.output.workspace import Workspace
    from urdfcal.result.fitted import FittedCalibration

FIGURES = (
    "residuals", "workspace", "joints", "convergence", "causes", "joint_models", "corrections", "fields", "enlarged",
    "magnitudes", "projection",
)  # fmt: skip
"""Names of all figures that a report may have."""
# Of a map of the workspace, and of one of an image, along the longer side.
_CELLS, _IMAGE_CELLS = 24, 10
# A portrait image as wide as half the page would fill it.
_TALLEST = 380.0
_BAR_HEIGHT = 15
# The arrow of a known length is about this share of an image's width.
_REFERENCE = 0.12
# Arrows reach so far out of the image. [its sides]
_BEYOND = 0.15
# What the maps of a workspace have the colours of.
_WHAT = {"nominal": "distance", "calibrated": "std. dev.", MOVED: "moved"}
# Fields of residuals whose factors differ less are not drawn twice.
_TWICE = 1.5


def figures(overview: Overview) -> dict[str, Figure]:
    """Put together a report's figures, by name; those that the calibration has nothing for are left out."""
    scene, calibration, table = overview.scene, overview.calibration, overview.scene.tables[0]
    corrections = parameter_charts(calibration)
    cost, _, step, *_ = convergence_charts(calibration)
    found = {
        "residuals": Figure([[by_pose(table, frame_times(calibration)), spread(table)]], 230),
        "workspace": Figure(_workspace(overview.workspaces), 250),
        "joints": Figure([[_joint_ranges(calibration)]], 60),
        "convergence": Figure([[cost, step]], 180),
    }
    by_cause, models = contribution_chart(calibration), joint_model_charts(calibration)
    if by_cause is not None:
        found["causes"] = Figure([[by_cause]], 40 + _BAR_HEIGHT * len(by_cause.y.ticks()))
    if models:
        found["joint_models"] = Figure(_in_rows(models, 2), 185)
    if corrections:
        found["corrections"] = Figure([corrections], 100)
    if scene.pixels is not None:
        found |= _images(scene, scene.pixels, calibration.estimate.cameras)
    if lenses := _projections(scene, calibration):
        height = min((720 / max(len(lenses), 2) - 62) / _flattest(calibration.estimate.cameras), _TALLEST) + 28
        found["projection"] = Figure(_in_rows(lenses, min(3, len(lenses))), height)
    return found


def _workspace(workspaces: Sequence[Workspace]) -> list[Sequence[Chart]]:
    """Each arm's maps, and shares beside two or below three."""
    shares = [replace(chart, colors=None) for chart in workspace_charts(workspaces)]
    return [
        row
        for of, chart in zip(workspaces, shares, strict=True)
        for row in _in_rows([*workspace_maps(of, named=len(workspaces) > 1), chart], 3)
    ]


def workspace_maps(workspace: Workspace, *, named: bool = False) -> list[Chart]:
    """The median tip error over distance from the base's axis and height, nominal and calibrated, in one scale.

    Where there are joint models, also how far they move the tip. Cells without a measured place are grey, unless all
    are: then the colours tell what is expected there. Titles name the link if they shall.
    """
    radius, height = np.hypot(workspace.tip[:, 0], workspace.tip[:, 1]), workspace.tip[:, 2]
    size = max(np.ptp(radius), np.ptp(height)) / _CELLS
    column, row = ((values - values.min()) // size for values in (radius, height))
    cells, cell = np.unique(np.stack([column, row], axis=1), axis=0, return_inverse=True)
    order = np.argsort(cell, kind="stable")
    ends = np.cumsum(np.bincount(cell))[:-1]
    median = {
        name: np.array([1e3 * np.median(group) for group in np.split(error[order], ends)])
        for name, error in workspace.errors.items()
    }
    known = np.bincount(cell, workspace.measured if workspace.measured.any() else None) > 0
    colors = Scale.holding(*(of[known] for of in median.values()), logarithmic=True, room=0.0)
    x, y = radius.min() + (cells[:, 0] + 0.5) * size, height.min() + (cells[:, 1] + 0.5) * size
    return [
        Chart(
            name,
            f"{name}, {workspace.link} [mm]" if named else f"{name}: {_WHAT[name]} [mm]",
            Scale(float(x.min() - size), float(x.max() + size)),
            Scale(float(y.min() - size), float(y.max() + size)),
            [
                Mark("cells", "not measured", x[~known], y[~known], palette.UNMEASURED, size),
                Mark("cells", "error", x[known], y[known], _shades(colors, of[known]), size),
            ],
            x_label="\u2192 radius, \u2191 height [m]",
            equal=True,
            colors=colors,
        )
        for name, of in median.items()
    ]


def _joint_ranges(calibration: FittedCalibration) -> Chart:
    """Where between its limits each joint was measured."""
    session = calibration.session
    joints = [(j, joint) for j, joint in enumerate(session.chain.joints) if joint.mimic is None]
    y = np.arange(len(joints), 0.0, -1.0)
    share, ends = [], []
    for j, joint in joints:
        value = session.q[:, j]
        low, high = joint.lower, joint.upper
        if not np.isfinite(high - low):
            low, high = (value.min(), value.max()) if joint.prismatic else (-np.pi, np.pi)
            value = value if joint.prismatic else np.arctan2(np.sin(value), np.cos(value))
        share.append(100.0 * (value - low) / (high - low))
        ends.append([share[-1].min(), share[-1].max()])
    values = np.array(share)
    marks = [
        Mark("hairlines", "limits", [[0.0, 100.0]] * len(y), np.stack([y, y], axis=-1), palette.INK),
        Mark("lines", "measured", np.array(ends), np.stack([y, y], axis=-1), palette.CALIBRATED),
        Mark("dots", "poses", values.ravel(), np.repeat(y, values.shape[1]), palette.CALIBRATED),
    ]
    names = {place: joint.name for place, (_, joint) in zip(y.tolist(), joints, strict=True)}
    x = Scale.holding(values, 0.0, 100.0, room=0.02)
    height = Scale(0.4, len(joints) + 0.6, names=names)
    return Chart("ranges", "poses between the joint's limits [%]", x, height, marks)


def _images(scene: CalibrationScene, pixels: ResidualTable, cameras: Sequence[Camera]) -> dict[str, Figure]:
    """Residuals over each camera's image: nominal and calibrated, these enlarged, and their size."""
    factor, enlarged = scene.pixel_factor, scene.field_factor
    fields = {
        "fields": [
            _field(pixels, cameras, c, name, factor, ("nominal", "calibrated"))
            for name in ("nominal", "calibrated")
            for c in range(len(cameras))
        ]
    }
    if enlarged > _TWICE * factor:
        alone = ("calibrated",)
        fields["enlarged"] = [_field(pixels, cameras, c, "calibrated", enlarged, alone) for c in range(len(cameras))]
    fields["magnitudes"] = _magnitudes(pixels, cameras)
    columns = max(min(3, len(cameras)), 2)
    shape = max((field.y.high - field.y.low) / (field.x.high - field.x.low) for field in fields["fields"])
    height = min((720 / columns - 30) * shape, _TALLEST) + 26
    found = {name: Figure(_in_rows(charts, min(3, len(cameras))), height) for name, charts in fields.items()}
    # There is a colour bar beside these, and no arrow of a known length below.
    found["magnitudes"] = replace(
        found["magnitudes"], height=min((720 / columns - 62) / _flattest(cameras), _TALLEST) + 28
    )
    return found


def _flattest(cameras: Sequence[Camera]) -> float:
    """The least width of an image for its height."""
    return min(camera.resolution[0] / camera.resolution[1] for camera in cameras)


def _all(cameras: Sequence[Camera]) -> list[tuple[int, Camera]]:
    return list(enumerate(cameras))


def _in_rows(charts: Sequence[Chart], columns: int) -> list[Sequence[Chart]]:
    return [charts[first : first + columns] for first in range(0, len(charts), columns)]


def _field(
    pixels: ResidualTable, cameras: Sequence[Camera], c: int, name: str, factor: float, beside: Sequence[str]
) -> Chart:
    """A camera's residuals as arrows over its image, with one of a known length: a bent field means a wrong lens.

    There is room for those of the other cameras with images of one size, and of the arms beside which it stands.
    """
    camera = cameras[c]
    cut = pixels.measured[(pixels.camera == c) & pixels.outlier]
    off, shown = pixels.by_arm[name] - pixels.measured, _shown(pixels, c, name)
    residual = off[shown]
    rms = np.sqrt(np.mean(np.sum(residual**2, axis=1))) if len(residual) else np.nan
    some = evenly(np.flatnonzero(shown), MOST_ARROWS)
    start, residual = pixels.measured[some], off[some]
    size = pixels.size_nominal if name == "nominal" else pixels.size
    colors = (0.8 * palette.by_sigma(size[some])).astype(np.uint8)
    # Cameras with images of one size are drawn in one scale.
    alike = [k for k, other in _all(cameras) if other.resolution == camera.resolution]
    room = _BEYOND * np.array(camera.resolution)
    held = [pixels.measured[np.isin(pixels.camera, alike)]]
    for arm in beside:
        seen = np.any([_shown(pixels, k, arm) for k in alike], axis=0)
        ends = pixels.measured[seen] + factor * (pixels.by_arm[arm] - pixels.measured)[seen]
        held.append(np.clip(ends, -room, room + camera.resolution))
    (left, right), (top, bottom) = image_range(camera.resolution, np.concatenate(held))
    length = reference_length(_REFERENCE * camera.resolution[0] / factor)
    beneath = bottom + 0.06 * (right - left)
    arrows = _arrows(start, factor * residual, ((left, right), (top, bottom)))
    known = _arrows(np.array([[left, beneath]]), factor * np.array([[length, 0.0]]))
    border = _border(camera)
    return Chart(
        f"{camera.name} {name}",
        f"{camera.name}, {name}: {rms:.3g} px rms, {factor:g} x",
        Scale(left, right),
        Scale(-beneath - 0.03 * (right - left), -top),
        [
            Mark("hairlines", "border", border[:, 0], border[:, 1], palette.FAINT),
            Mark("lines", "residuals", arrows[..., 0], arrows[..., 1], colors),
            Mark("dots", "outliers", cut[:, 0], -cut[:, 1], palette.OUTLIER),
            Mark("lines", "reference", known[..., 0], known[..., 1], palette.INK),
        ],
        equal=True,
        axes=False,
        labels=((left + factor * length + 0.08 * (right - left), -beneath - 0.04 * (right - left), f"{length:g} px"),),
    )


def _shown(pixels: ResidualTable, c: int, name: str) -> Bools:
    """Which detections (S,) of a camera are used, and predicted by an arm."""
    shown: Bools = (pixels.camera == c) & pixels.used & np.isfinite(pixels.by_arm[name][:, 0])
    return shown


def _arrows(start: Floats, arrow: Floats, area: Sequence[tuple[float, float]] | None = None) -> Floats:
    """Outlines (S, 5, 2) of arrows; pixels are counted from the top, and the vertical axis is turned round.

    What leaves an area is cut there, and has no head.
    """
    whole = np.ones(len(start), dtype=bool)
    if area is not None:
        low, high = np.transpose(area)
        bound = np.where(arrow > 0.0, high, low) - start
        share = np.divide(bound, arrow, out=np.ones_like(arrow), where=arrow != 0.0).min(axis=1, initial=1.0)
        whole, arrow = share >= 1.0, share[:, None] * arrow
    across = 0.2 * np.column_stack([-arrow[:, 1], arrow[:, 0]]) * whole[:, None]
    end = start + arrow
    neck = np.where(whole[:, None], start + 0.7 * arrow, end)
    result: Floats = np.stack([start, end, neck + across, end, neck - across], axis=1) * [1.0, -1.0]
    return result


def _border(camera: Camera) -> Floats:
    width, height = camera.resolution
    return np.array([[0.0, 0.0], [width, 0.0], [width, -height], [0.0, -height], [0.0, 0.0]])


def _magnitudes(pixels: ResidualTable, cameras: Sequence[Camera]) -> list[Chart]:
    """How large the calibrated residuals are over each image, in one scale; without colour nothing was seen."""
    found = []
    for c, camera in _all(cameras):
        used = (pixels.camera == c) & pixels.used & np.isfinite(pixels.predicted[:, 0])
        size = max(camera.resolution) / _IMAGE_CELLS
        place = pixels.measured[used] + CORNER
        outside = ((place < 0.0) | (place >= camera.resolution)).any(axis=1)
        cells, cell = np.unique(place // size, axis=0, return_inverse=True)
        square = np.sum((pixels.predicted - pixels.measured)[used] ** 2, axis=1)
        rms = np.sqrt(np.bincount(cell.ravel(), square, len(cells)) / np.maximum(np.bincount(cell.ravel()), 1))
        found.append((camera, size, cells, rms, 100.0 * np.mean(outside) if outside.any() else 0.0))
    colors = Scale.holding(*(rms for *_, rms, _ in found), logarithmic=True, room=0.0)
    charts = []
    for camera, size, cells, rms, outside in found:
        border = _border(camera)
        x, y = (cells[:, 0] + 0.5) * size, -(cells[:, 1] + 0.5) * size
        # Images of one size are drawn in one scale.
        every = np.concatenate([of for other, _, of, *_ in found if other.resolution == camera.resolution])
        most = np.ceil(np.divide(camera.resolution, size))
        # The last cells of an image end with it; whole ones beyond it hold what was detected there.
        first, last = every.min(axis=0, initial=0.0), every.max(axis=0, initial=0.0) + 1
        (left, top), (right, bottom) = size * first, np.where(last > most, size * last, camera.resolution)
        share = np.all((cells >= 0) & (cells < most), axis=1).sum() / most.prod()
        beyond = f"; {outside:.2g} % outside" if outside else ""
        charts.append(
            Chart(
                f"{camera.name} magnitude",
                f"{camera.name}: rms [px], in {100 * share:.0f} % of the image{beyond}",
                Scale(float(left), float(right)),
                Scale(-float(bottom), -float(top)),
                [
                    Mark("cells", "rms", x, y, _shades(colors, rms), size),
                    Mark("hairlines", "border", border[:, 0], border[:, 1], palette.FAINT),
                ],
                equal=True,
                axes=False,
                colors=colors,
            )
        )
    return charts


def _projections(scene: CalibrationScene, calibration: FittedCalibration) -> list[Chart]:
    """How well each lens that was estimated tells where light falls, over its image; in one scale."""
    found, pixels = [], scene.pixels
    if pixels is None:
        return []
    distance = np.linalg.norm(scene.rays[:, 1] - scene.rays[:, 0], axis=1)
    for c, camera in _all(calibration.estimate.cameras):
        used = (pixels.camera == c) & pixels.used & np.isfinite(distance)
        size = max(camera.resolution) / (2 * _IMAGE_CELLS)
        # Some images are larger than they are said to be; those of one size are drawn in one scale.
        alike = [k for k, other in _all(calibration.estimate.cameras) if other.resolution == camera.resolution]
        seen = pixels.measured[np.isin(pixels.camera, alike) & pixels.used] + CORNER
        first = np.floor(seen.min(axis=0, initial=0.0) / size) * size
        last = np.maximum(seen.max(axis=0, initial=0.0), camera.resolution)
        u, v = (np.arange(low + 0.5 * size, high, size) for low, high in zip(first, last, strict=True))
        uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        sigma = projection_sigma(calibration.problem, calibration.fit, c, uv, pixels.measured[used], distance[used])
        if sigma is not None:
            found.append((camera, size, uv, sigma))
    if not found:
        return []
    colors = Scale.holding(*(sigma for *_, sigma in found), logarithmic=True, room=0.0)
    charts = []
    for camera, size, uv, sigma in found:
        border = _border(camera)
        charts.append(
            Chart(
                f"{camera.name} projection",
                f"{camera.name}: standard deviation [px]",
                Scale(float(uv[:, 0].min() - size / 2), float(uv[:, 0].max() + size / 2)),
                Scale(-float(uv[:, 1].max() + size / 2), -float(uv[:, 1].min() - size / 2)),
                [
                    Mark("cells", "sigma", uv[:, 0], -uv[:, 1], _shades(colors, sigma), size),
                    Mark("hairlines", "border", border[:, 0], border[:, 1], palette.FAINT),
                ],
                equal=True,
                axes=False,
                colors=colors,
            )
        )
    return charts


def _shades(colors: Scale, values: Floats) -> NDArray[np.uint8]:
    """Colours (K, 3) of values in a scale."""
    return palette.viridis(np.clip(colors.share(values), 0.0, 1.0))
