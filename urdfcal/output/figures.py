"""The figures of the report, as SVG to stand in a page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.output import charts
from urdfcal.output.chart import Chart, Mark, Scale
from urdfcal.output.palette import FAINT, OUTLIER, UNMEASURED, by_sigma, viridis
from urdfcal.output.scene import image_range
from urdfcal.output.svg import svg

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.output.findings import Overview
    from urdfcal.output.fitted import ResidualTable
    from urdfcal.output.scene import CalibrationScene, Workspace

_CELLS = 24
# A portrait image as wide as half the page would fill it.
_TALLEST = 380.0


def draw(overview: Overview) -> dict[str, str]:
    """Draw the figures of a report.

    Returns:
        SVG elements by name; those that the calibration has nothing for are left out.
    """
    scene, workspace, table = overview.scene, overview.workspace, overview.scene.tables[0]
    corrections = charts.parameter_charts(overview.calibration)
    cost, _, step, *_ = charts.convergence_charts(overview.calibration)
    maps = [
        _map(name, workspace, 1e3 * error)
        for name, error in (("nominal", workspace.before), ("calibrated", workspace.after))
    ]
    figures = {
        "residuals": svg([[charts.by_pose(table), charts.spread(table)]], 230),
        "workspace": svg([[*maps, charts.workspace_chart(workspace)]], 250),
        "convergence": svg([[cost, step]], 180),
    }
    if corrections:
        figures["corrections"] = svg([corrections], 100)
    if scene.pixels is not None:
        figures["field"] = _fields(scene, scene.pixels)
    return figures


def _map(name: str, workspace: Workspace, error: Floats) -> Chart:
    """The median tip error over the distance from the base's axis and the height, grey where nothing was measured."""
    radius, height = np.hypot(workspace.tip[:, 0], workspace.tip[:, 1]), workspace.tip[:, 2]
    size = max(np.ptp(radius), np.ptp(height)) / _CELLS
    column, row = ((values - values.min()) // size for values in (radius, height))
    cells, cell = np.unique(np.stack([column, row], axis=1), axis=0, return_inverse=True)
    order = np.argsort(cell, kind="stable")
    groups = np.split(error[order], np.cumsum(np.bincount(cell))[:-1])
    median = np.array([np.median(group) for group in groups])
    known = np.bincount(cell, workspace.measured) > 0
    colors = Scale.holding(median[known], room=0.0)
    x, y = radius.min() + (cells[:, 0] + 0.5) * size, height.min() + (cells[:, 1] + 0.5) * size
    return Chart(
        name,
        f"{name} [mm]",
        Scale(float(x.min() - size), float(x.max() + size)),
        Scale(float(y.min() - size), float(y.max() + size)),
        [
            Mark("cells", "not measured", x[~known], y[~known], UNMEASURED, size),
            Mark("cells", "error", x[known], y[known], viridis(colors.share(median[known])), size),
        ],
        x_label="from the base's z axis [m]",
        equal=True,
        colors=colors,
    )


def _fields(scene: CalibrationScene, pixels: ResidualTable) -> str:
    """What is left of the residuals over each camera's image: a bent field means a wrong lens."""
    fields = [_field(scene, pixels, c) for c in range(len(scene.arm.cameras))]
    columns = max(min(3, len(fields)), 2)
    shape = max((field.y.high - field.y.low) / (field.x.high - field.x.low) for field in fields)
    rows = [fields[first : first + columns] for first in range(0, len(fields), columns)]
    if len(rows[-1]) < columns:
        rows[-1] = [*rows[-1], *[_NOTHING] * (columns - len(rows[-1]))]
    return svg(rows, min((720 / columns - 30) * shape, _TALLEST) + 26)


def _field(scene: CalibrationScene, pixels: ResidualTable, c: int) -> Chart:
    camera = scene.arm.cameras[c]
    mine = pixels.camera == c
    used, cut = mine & pixels.used & np.isfinite(pixels.predicted[:, 0]), pixels.measured[mine & pixels.outlier]
    start, residual = pixels.measured[used], (pixels.predicted - pixels.measured)[used]
    arrow = scene.field_factor * residual
    across = 0.2 * np.column_stack([-arrow[:, 1], arrow[:, 0]])
    end, neck = start + arrow, start + 0.7 * arrow
    # Pixels are counted from the top: the vertical axis is turned round.
    arrows = np.stack([start, end, neck + across, end, neck - across], axis=1) * [1.0, -1.0]
    (left, right), (top, bottom) = image_range(camera.resolution, pixels.measured[mine])
    width, height = camera.resolution
    rms = np.sqrt(np.mean(np.sum(residual**2, axis=1))) if len(residual) else np.nan
    colors = (0.8 * by_sigma(pixels.size[used])).astype(np.uint8)
    border = np.array([[0, 0], [width, 0], [width, -height], [0, -height], [0, 0]])
    return Chart(
        camera.name,
        f"{camera.name}: {rms:.3g} px rms, arrows {scene.field_factor:g} x",
        Scale(left, right),
        Scale(-bottom, -top),
        [
            Mark("hairlines", "border", border[:, 0], border[:, 1], FAINT),
            Mark("lines", "residuals", arrows[..., 0], arrows[..., 1], colors),
            Mark("dots", "outliers", cut[:, 0], -cut[:, 1], OUTLIER),
        ],
        equal=True,
        axes=False,
    )


_NOTHING = Chart("", "", Scale(0.0, 1.0), Scale(0.0, 1.0), [], axes=False)
