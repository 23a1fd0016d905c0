"""Charts and time series of a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from urdfcal.output.charts import paths
from urdfcal.output.palette import BACKGROUND, CALIBRATED, FAINT, GRID, INK, OF_ARM, PARAMETER_COLORS
from urdfcal.output.stream import ITERATION

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.output.chart import Chart
    from urdfcal.output.scene import CalibrationScene
    from urdfcal.output.stream import Layer
    from urdfcal.result.fitted import FittedCalibration

# Size of the plotted area; only its shape is seen.
_WIDTH, _HEIGHT = 150.0, 105.0
# Rows with names need so much height each, lest the names overlap; beyond the limit they had better.
_ROW, _TALLEST = 7.0, 205.0
# Room for tick labels: numbers and names to the left, and right, above and below.
_NUMBERS, _NAMES, _RIGHT, _ABOVE, _BELOW = 24.0, 75.0, 8.0, 6.0, 16.0
# rerun takes negative radii as points on the screen.
_HAIR, _NONE = -0.5, 0.0
_RADII = {"dots": -2.0, "lines": -0.9, "hairlines": _HAIR}


def chart_view(chart: Chart, parent: str) -> rrb.View:
    """The view of a chart whose entity is a child of ``parent``."""
    name = f"{chart.title}, by {chart.x_label}" if chart.x_label else chart.title
    return rrb.Spatial2DView(
        origin=f"{parent}/{rr.escape_entity_path_part(chart.name)}",
        name=f"{name} (blue: nominal, green: calibrated)" if chart.legend else name,
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-_beside(chart), _WIDTH + _RIGHT], y_range=[-_ABOVE, _height(chart) + _BELOW]
        ),
        background=BACKGROUND,
    )


def log_chart(parent: Layer, chart: Chart) -> None:
    """Draw a chart at a child of ``parent``."""
    layer, height = parent.at(chart.name), _height(chart)
    x = _WIDTH * chart.x.share(list(chart.x_ticks))
    y = height * (1.0 - chart.y.share(list(chart.y_ticks)))
    grid = [[[0.0, v], [_WIDTH, v]] for v in y]
    layer.at("grid").fixed(rr.LineStrips2D(grid, colors=GRID, radii=_HAIR, draw_order=-1.0))
    frame = [[0.0, 0.0], [0.0, height], [_WIDTH, height]]
    layer.at("frame").fixed(rr.LineStrips2D([frame], colors=FAINT, radii=_HAIR))
    # rerun writes labels centred below their points.
    ticks = [*([u, height] for u in x), *([-_beside(chart) / 2, v - 5.0] for v in y)]
    names = [*chart.x_ticks.values(), *chart.y_ticks.values()]
    layer.at("ticks").fixed(rr.Points2D(ticks, radii=_NONE, labels=names, colors=INK, show_labels=True))
    for order, mark in enumerate(chart.marks):
        shapes, colors = chart.shapes(mark, _WIDTH, height)
        kind: Any = rr.Points2D if mark.kind == "dots" else rr.LineStrips2D
        layer.at(mark.name).fixed(kind(shapes, radii=_RADII[mark.kind], colors=colors, draw_order=float(order)))


def _height(chart: Chart) -> float:
    return max(_HEIGHT, min(_ROW * len(chart.y_names or ()), _TALLEST))


def _beside(chart: Chart) -> float:
    return _NUMBERS if chart.y_names is None else _NAMES


def log_residuals(base: Layer, scene: CalibrationScene) -> None:
    """Log the rms residual of every pose, nominal and calibrated, in px or mm, without outliers."""
    for table in scene.tables:
        for name, predicted in table.by_arm.items():
            pose, rms = table.rms_by(table.pose, predicted)
            plot = base.at("plots", f"residual_{table.unit}", name)
            plot.fixed(rr.SeriesLines(colors=OF_ARM[name], names=f"{name} [{table.unit}]", widths=1.5))
            plot.each(rr.Scalars, {"scalars": rms}, pose)


def log_convergence(base: Layer, calibration: FittedCalibration, scene: CalibrationScene) -> None:
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
            colors=[PARAMETER_COLORS[name]] * 3,
            widths=[2.0, 0.7, 0.7],
            names=[name, f"{name} - sigma", f"{name} + sigma"],
        )
        _log_iterations(plots.at("parameters", joint, name), 0, np.column_stack([way[:, i, k], band]), series)


def _log_iterations(plot: Layer, first: int, values: Floats, series: rr.SeriesLines | None = None) -> None:
    plot.fixed(series or rr.SeriesLines(colors=CALIBRATED))
    rows = rr.TimeColumn(ITERATION, sequence=np.arange(first, first + len(values)))
    columns = rr.Scalars.columns(scalars=values.ravel())
    if values.ndim == 2:
        columns = columns.partition([values.shape[1]] * len(values))
    rr.send_columns(plot.path, [rows], columns, recording=plot.stream)
