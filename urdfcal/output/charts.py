"""The charts of report and recording: residuals and what they might depend on, parameters, convergence, workspace."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.blocks.arm import LENGTHS
from urdfcal.output.chart import Chart, Mark, Scale
from urdfcal.output.fitted import convergence_of, entries_of_rows
from urdfcal.output.palette import CALIBRATED, COMPONENTS, INK, NOMINAL, PARAMETER_COLORS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.output.chart import Color
    from urdfcal.output.findings import Overview
    from urdfcal.output.fitted import ResidualTable
    from urdfcal.output.scene import Workspace
    from urdfcal.result.fitted import FittedCalibration

# Residuals in standard deviations beyond this are off the charts.
_SIGMAS = 6.0
_BINS = 8
_BOTH = (NOMINAL, CALIBRATED)
SYMBOLS = {"theta": "\u03b8", "alpha": "\u03b1", "beta": "\u03b2"}

RESIDUALS = """\
**Residuals** without the measurements taken out of the fit. Blue: nominal, green: calibrated, grey: declared noise.

Against distance and joints: calibrated, in units of the declared noise; {parts}. Lines are means of bins: noise keeps
them near zero, a trend is an effect that the model lacks.
"""
PART_COLORS = ("light blue", "orange", "violet")
CONVERGENCE = """\
**Convergence**, iteration by iteration (0: nominal). Each joint's offsets in mm and mrad; light blue: theta, dark
blue: d, red: a, orange: alpha, violet: beta. Hairlines: the estimate minus and plus one standard deviation.

The same as time series: below `plots`, on the timeline `iteration`.
"""


def all_charts(overview: Overview) -> list[Chart]:
    """Every chart of a recording."""
    return [
        *residual_charts(overview),
        *parameter_charts(overview.calibration),
        *convergence_charts(overview.calibration),
        workspace_chart(overview.workspace),
    ]


def residual_charts(overview: Overview) -> list[Chart]:
    """Residuals by pose and camera, against the declared noise, the distance, and every joint."""
    scene, calibration, table = overview.scene, overview.calibration, overview.scene.tables[0]
    charts = [by_pose(table), spread(table)]
    if scene.pixels is not None:
        charts.insert(1, _by_camera(scene.pixels, [camera.name for camera in scene.arm.cameras]))
        distance = np.linalg.norm(scene.rays[:, 1] - scene.rays[:, 0], axis=1)
        charts.append(_against("distance", "Distance to the camera [m]", distance, scene.pixels))
    for j, joint in enumerate(calibration.chain.joints):
        unit = "m" if joint.prismatic else "rad"
        value = calibration.session.q[table.pose, j]
        charts.append(_against(f"joint {j + 1}", f"{joint.name} [{unit}]", value, table))
    return charts


def by_pose(table: ResidualTable) -> Chart:
    """The rms residual of each pose, nominal and calibrated."""
    (pose, before), (_, after) = (table.rms_by_pose(predicted) for predicted in (table.nominal, table.predicted))
    x = Scale.holding(pose + 1, whole=True)
    return Chart(
        "by pose",
        f"rms of each pose [{table.unit}]",
        x,
        Scale.holding(before, after, table.noise, logarithmic=True),
        [
            Mark("lines", "declared", [x.low, x.high], [table.noise, table.noise], INK),
            Mark("dots", "nominal", pose + 1, before, NOMINAL),
            Mark("dots", "calibrated", pose + 1, after, CALIBRATED),
        ],
        x_label="pose",
        legend=("nominal", "calibrated", "declared"),
        breadth=3.0,
    )


def _by_camera(pixels: ResidualTable, names: list[str]) -> Chart:
    camera = pixels.camera[pixels.used]
    index = np.arange(float(len(names)))
    with np.errstate(invalid="ignore"):
        before, after = (
            np.sqrt(
                np.bincount(camera, np.sum((predicted - pixels.measured)[pixels.used] ** 2, axis=1), len(names))
                / np.bincount(camera, minlength=len(names))
            )
            for predicted in (pixels.nominal, pixels.predicted)
        )
    return Chart(
        "by camera",
        "By camera [px]",
        Scale(-0.7, len(names) - 0.3),
        Scale(0.0, 1.1 * float(np.nanmax(np.append(before, after)))),
        [
            Mark("lines", "nominal", *_bars(index - 0.15, before, 0.1), NOMINAL),
            Mark("lines", "calibrated", *_bars(index + 0.15, after, 0.1), CALIBRATED),
        ],
        x_names=dict(zip(index.tolist(), names, strict=True)),
    )


def _bars(at: Floats, length: Floats, half: float) -> tuple[Floats, Floats]:
    """Outlines (L, 4) of bars from zero: across, and along."""
    zero = np.zeros_like(length)
    across = np.stack([at - half, at - half, at + half, at + half], axis=-1)
    return across, np.stack([zero, length, length, zero], axis=-1)


def spread(table: ResidualTable) -> Chart:
    """How the residuals are distributed, beside the normal distribution that was declared."""
    edges, x = np.linspace(-_SIGMAS, _SIGMAS, 49), np.linspace(-_SIGMAS, _SIGMAS, 121)
    bell = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    marks = [Mark("lines", "declared", x, bell, INK)]
    tallest = float(bell.max())
    for name, predicted, color in zip(("nominal", "calibrated"), (table.nominal, table.predicted), _BOTH, strict=True):
        sigmas = table.sigmas(predicted).ravel()
        share = np.histogram(sigmas, edges)[0] / max(len(sigmas), 1) / np.diff(edges)
        marks.append(Mark("lines", name, np.repeat(edges, 2)[1:-1], np.repeat(share, 2), color))
        tallest = max(tallest, float(share.max()))
    return Chart(
        "spread",
        "Spread [declared noise]",
        Scale(-_SIGMAS, _SIGMAS),
        Scale(0.0, 1.1 * tallest),
        marks,
        x_label="residual / declared standard deviation",
        breadth=2.0,
    )


def _against(name: str, title: str, value: Floats, table: ResidualTable) -> Chart:
    """Residuals over something they should not depend on, and the means of bins of equal number."""
    known = np.isfinite(value[table.used])
    value, sigmas = value[table.used][known], table.sigmas(table.predicted)[known]
    bins = np.array_split(np.argsort(value, kind="stable"), min(_BINS, max(1, len(value) // 5)))
    centre = [np.mean(value[b]) for b in bins]
    components = range(sigmas.shape[1])
    faint = [tuple(c // 2 for c in color) for color in COMPONENTS]
    marks = [Mark("dots", f"component {k}", value, sigmas[:, k], faint[k]) for k in components]
    marks += [
        Mark("lines", f"mean {k}", centre, [np.mean(sigmas[b, k]) for b in bins], COMPONENTS[k]) for k in components
    ]
    reach = float(np.clip(np.nanpercentile(np.abs(sigmas), 99), 3.0, 100.0))
    return Chart(name, title, Scale.holding(value), Scale(-reach, reach), marks)


def parameter_charts(calibration: FittedCalibration) -> list[Chart]:
    """Corrections of the arm's rows as bars with their 95 % intervals, lengths and angles apart."""
    offsets, sigmas = convergence_of(calibration).offsets[-1], calibration.sigmas()
    columns, labels = calibration.geometry.columns, calibration.geometry.labels
    charts = []
    for kind, unit in (("lengths", "mm"), ("angles", "mrad")):
        entries = [(row, k) for row, k in entries_of_rows(calibration) if (columns[k] in LENGTHS) == (unit == "mm")]
        if not entries:
            continue
        value, margin = (np.array([of[i] for i in entries]) for of in (offsets, 1.96e3 * sigmas))
        known = np.isfinite(margin)
        y = np.arange(len(entries), 0.0, -1.0)
        ends = np.stack([value - margin, value + margin], axis=-1)[known]
        across, along = _bars(y[known], value[known], 0.25)
        names = [f"{labels[row]} {SYMBOLS.get(columns[k], columns[k])}" for row, k in entries]
        height = Scale(0.2, len(entries) + 0.8)
        charts.append(
            Chart(
                kind,
                f"{kind} [{unit}]",
                Scale.holding(ends, 0.0),
                height,
                [
                    Mark("lines", "offsets", along, across, CALIBRATED),
                    Mark("lines", "intervals", ends, np.stack([y[known], y[known]], axis=-1), INK),
                    Mark("hairlines", "zero", [0.0, 0.0], [height.low, height.high], INK),
                    Mark("dots", "fixed", value[~known], y[~known], NOMINAL),
                ],
                y_names=dict(zip(y.tolist(), names, strict=True)),
            )
        )
    return charts


def convergence_charts(calibration: FittedCalibration) -> list[Chart]:
    """Cost, damping and step of every iteration, and how each joint's parameters converged."""
    way = convergence_of(calibration)
    number = np.arange(1.0, len(way.cost) + 1)
    return [
        _course("cost", "cost", number, way.cost),
        _course("damping", "damping", number, way.damping),
        _course("step", "step, in standard deviations of the estimate", number, way.step),
        *_paths(calibration, way.offsets),
    ]


def _course(name: str, title: str, number: Floats, values: Floats) -> Chart:
    marks = [Mark("lines", "line", number, values, CALIBRATED), Mark("dots", "dots", number, values, CALIBRATED)]
    x, y = Scale.holding(number, whole=True), Scale.holding(values, logarithmic=True)
    return Chart(name, title, x, y, marks, x_label="iteration")


def _paths(calibration: FittedCalibration, paths: Floats) -> Iterable[Chart]:
    sigmas = 1e3 * calibration.sigmas()
    number = np.arange(paths.shape[0], dtype=float)
    columns = calibration.geometry.columns
    for i, joint in enumerate(calibration.geometry.labels):
        marks = []
        for k in np.flatnonzero(np.isfinite(sigmas[i])):
            color, ends = PARAMETER_COLORS[columns[k]], paths[-1, i, k] + sigmas[i, k] * np.array([[-1.0], [1.0]])
            band = np.repeat(ends, 2, axis=1)
            marks.append(Mark("hairlines", f"{columns[k]} band", [[number[0], number[-1]]] * 2, band, color))
            marks.append(Mark("lines", columns[k], number, paths[:, i, k], color))
        if marks:
            y = Scale.holding(*(mark.y for mark in marks))
            yield Chart(f"path of {joint}", f"{joint} [mm, mrad]", Scale.holding(number, whole=True), y, marks)


def workspace_chart(workspace: Workspace) -> Chart:
    """The share of the workspace that has a tip error below a value."""
    errors: Sequence[tuple[str, Floats, Color]] = (
        ("nominal", workspace.before, NOMINAL),
        ("calibrated", workspace.after, CALIBRATED),
    )
    share = np.linspace(0.0, 100.0, len(workspace.tip))
    return Chart(
        "shares",
        "% of the workspace below",
        Scale.holding(1e3 * workspace.before, 1e3 * workspace.after, logarithmic=True),
        Scale(0.0, 100.0),
        [Mark("lines", name, 1e3 * np.sort(error), share, color) for name, error, color in errors],
        x_label="tip error [mm]",
        legend=("nominal", "calibrated"),
    )
