"""The charts of a recording: residuals and what they might depend on, parameters, convergence."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.output.chart import Chart, Dots, Lines, Scale
from urdfcal.output.palette import CALIBRATED, COMPONENTS, INK, NOMINAL, PARAMETER_COLORS
from urdfcal.output.scene import LENGTHS, UNITS, rms_by_pose

if TYPE_CHECKING:
    from collections.abc import Iterable

    from urdfcal.arrays import Floats, Ints
    from urdfcal.output.overview import Overview
    from urdfcal.output.scene import Sightings
    from urdfcal.output.workspace import Workspace
    from urdfcal.pipeline import FittedCalibration

# Residuals in standard deviations beyond this are off the charts.
_SIGMAS = 6.0
_BINS = 8

RESIDUALS = """\
**Residuals** without the sightings taken out of the fit. Blue: as drawn, green: calibrated, white: declared noise.

Against distance and joints: calibrated, in units of the declared noise; {parts}. Lines are means of bins: noise keeps
them near zero, a trend is something the model does not have.
"""
PARTS = {2: "light blue: u, orange: v", 3: "light blue: x, orange: y, violet: z"}
CONVERGENCE = """\
**Convergence**, iteration by iteration (0: as drawn). Each joint's offsets in mm and mrad; light blue: theta, dark
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
    scene, calibration = overview.scene, overview.calibration
    table = scene.tables[0]
    charts = [_by_pose(table), _spread(table)]
    if scene.pixels is not None:
        names = [camera.name for camera in calibration.estimate.cameras]
        charts.insert(1, _by_camera(scene.pixels, names))
        eyes = scene.views[scene.pixels.camera, scene.pixels.pose, :3, 3]
        seen = scene.rays[:, 1]
        charts.append(_against("distance", "Distance to the camera [m]", np.linalg.norm(seen - eyes, axis=1), table))
    for j, joint in enumerate(calibration.chain.joints):
        unit = "m" if joint.prismatic else "rad"
        value = calibration.session.q[table.pose, j]
        charts.append(_against(f"joint {j + 1}", f"{joint.name} [{unit}]", value, table))
    return charts


def _by_pose(table: Sightings) -> Chart:
    unit, scale = UNITS[table.measured.shape[1]]
    used = ~table.outlier
    series = [
        rms_by_pose(table.pose[used], scale * (predicted - table.measured)[used])
        for predicted in (table.nominal, table.predicted)
    ]
    (pose, before), (_, after) = series
    noise = scale * np.sqrt(table.measured.shape[1]) * np.median(table.sigma)
    x = Scale.holding(pose)
    return Chart(
        "by pose",
        f"By pose [{unit}]",
        x,
        Scale.holding(before, after, noise, logarithmic=True),
        [
            Lines("declared", [x.low, x.high], [noise, noise], INK),
            Dots("nominal", pose, before, NOMINAL),
            Dots("calibrated", pose, after, CALIBRATED),
        ],
    )


def _by_camera(pixels: Sightings, names: list[str]) -> Chart:
    used = ~pixels.outlier
    index = np.arange(float(len(names)))
    before, after = (
        _grouped_rms(pixels.camera[used], (predicted - pixels.measured)[used], len(names))
        for predicted in (pixels.nominal, pixels.predicted)
    )
    x, y = Scale(-0.7, len(names) - 0.3), Scale(0.0, 1.1 * float(np.nanmax(np.append(before, after))))
    return Chart(
        "by camera",
        "By camera [px]",
        x,
        y,
        [*_bars("nominal", index - 0.15, before, NOMINAL), *_bars("calibrated", index + 0.15, after, CALIBRATED)],
        x_names=dict(zip(index.astype(float).tolist(), names, strict=True)),
    )


def _grouped_rms(group: Ints, residual: Floats, count: int) -> Floats:
    square = np.sum(residual**2, axis=1)
    with np.errstate(invalid="ignore"):
        result: Floats = np.sqrt(np.bincount(group, square, count) / np.bincount(group, minlength=count))
    return result


def _bars(name: str, x: Floats, height: Floats, color: tuple[int, ...]) -> list[Lines]:
    half = 0.1
    outline = np.stack([x - half, x - half, x + half, x + half], axis=-1)
    zero = np.zeros_like(height)
    return [Lines(name, outline, np.stack([zero, height, height, zero], axis=-1), color)]


def _spread(table: Sightings) -> Chart:
    used = ~table.outlier
    edges = np.linspace(-_SIGMAS, _SIGMAS, 49)
    x = np.linspace(-_SIGMAS, _SIGMAS, 121)
    bell = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    marks: list[Dots | Lines] = [Lines("declared", x, bell, INK)]
    tallest = float(bell.max())
    for name, predicted, color in (("nominal", table.nominal, NOMINAL), ("calibrated", table.predicted, CALIBRATED)):
        sigmas = ((predicted - table.measured) / table.sigma[:, None])[used].ravel()
        share = np.histogram(sigmas, edges)[0] / max(len(sigmas), 1) / np.diff(edges)
        marks.append(Lines(name, np.repeat(edges, 2)[1:-1], np.repeat(share, 2), color))
        tallest = max(tallest, float(share.max()))
    return Chart("spread", "Spread [declared noise]", Scale(-_SIGMAS, _SIGMAS), Scale(0.0, 1.1 * tallest), marks)


def _against(name: str, title: str, value: Floats, table: Sightings) -> Chart:
    """Residuals over something they should not depend on, and the means of bins of equal number."""
    used = ~table.outlier & np.isfinite(value)
    sigmas = ((table.predicted - table.measured) / table.sigma[:, None])[used]
    value = value[used]
    bins = np.array_split(np.argsort(value, kind="stable"), min(_BINS, max(1, len(value) // 5)))
    centre = [np.mean(value[b]) for b in bins]
    marks: list[Dots | Lines] = [
        Dots(f"component {k}", value, sigmas[:, k], tuple(c // 2 for c in COMPONENTS[k]))
        for k in range(sigmas.shape[1])
    ]
    marks += [
        Lines(f"mean {k}", centre, [np.mean(sigmas[b, k]) for b in bins], COMPONENTS[k]) for k in range(sigmas.shape[1])
    ]
    reach = float(np.clip(np.nanpercentile(np.abs(sigmas), 99), 3.0, 100.0))
    return Chart(name, title, Scale.holding(value), Scale(-reach, reach), marks)


def parameter_charts(calibration: FittedCalibration) -> list[Chart]:
    """Corrections of the DH rows as bars with their standard deviations, lengths and angles apart."""
    offsets, sigmas = 1e3 * calibration.estimate.offsets, 1e3 * calibration.sigmas()
    columns, labels = calibration.geometry.columns, calibration.geometry.labels
    charts = []
    for kind, unit in (("lengths", "mm"), ("angles", "mrad")):
        entries = [
            (row, columns.index(name)) for row, name in calibration.corrected if (name in LENGTHS) == (unit == "mm")
        ]
        if not entries:
            continue
        value, sigma = (np.nan_to_num([values[i] for i in entries]) for values in (offsets, sigmas))
        y = np.arange(len(entries), 0.0, -1.0)
        ends = np.stack([y - 0.25, y - 0.25, y + 0.25, y + 0.25], axis=-1)
        zero = np.zeros_like(value)
        names = [f"{labels[row]} {columns[k]}" for row, k in entries]
        charts.append(
            Chart(
                kind,
                f"Corrections of {kind} [{unit}]",
                Scale.holding(value - sigma, value + sigma, 0.0),
                Scale(0.2, len(entries) + 0.8),
                [
                    Lines("offsets", np.stack([zero, value, value, zero], axis=-1), ends, CALIBRATED),
                    Lines("sigmas", np.stack([value - sigma, value + sigma], axis=-1), np.stack([y, y], axis=-1), INK),
                    Lines("zero", [0.0, 0.0], [0.2, len(entries) + 0.8], INK, thin=True),
                ],
                y_names=dict(zip(y.tolist(), names, strict=True)),
            )
        )
    return charts


def convergence_charts(calibration: FittedCalibration) -> list[Chart]:
    """Cost, damping and step of every iteration, and how each joint's parameters found their place."""
    history = calibration.fit.history
    number = np.arange(1.0, len(history) + 1)
    charts = []
    for name, title, values in (
        ("cost", "Cost", [step.cost for step in history]),
        ("damping", "Damping", [step.damping for step in history]),
        ("step", "Step [standard deviations]", [step.step for step in history]),
    ):
        y = Scale.holding(values, logarithmic=True)
        marks: list[Dots | Lines] = [
            Lines("line", number, values, CALIBRATED),
            Dots("dots", number, values, CALIBRATED),
        ]
        charts.append(Chart(name, title, Scale.holding(number), y, marks))
    return [*charts, *_paths(calibration)]


def _paths(calibration: FittedCalibration) -> Iterable[Chart]:
    paths, sigmas = parameter_paths(calibration), 1e3 * calibration.sigmas()
    number = np.arange(paths.shape[0], dtype=float)
    columns = calibration.geometry.columns
    for i, joint in enumerate(calibration.geometry.labels):
        estimated = [k for k in range(len(columns)) if np.isfinite(sigmas[i, k])]
        if not estimated:
            continue
        marks: list[Dots | Lines] = []
        for k in estimated:
            color = PARAMETER_COLORS[columns[k]]
            low, high = paths[-1, i, k] - sigmas[i, k], paths[-1, i, k] + sigmas[i, k]
            ends = [[number[0], number[-1]]] * 2
            marks.append(Lines(f"{columns[k]} band", ends, [[low, low], [high, high]], color, thin=True))
            marks.append(Lines(columns[k], number, paths[:, i, k], color))
        lines = [mark.y for mark in marks]
        yield Chart(
            f"path of {joint}",
            f"{joint} [mm, mrad]",
            Scale.holding(number),
            Scale.holding(*lines),
            marks,
        )


def parameter_paths(calibration: FittedCalibration) -> Floats:
    """The arm's offsets at the start and after every iteration, (I + 1, rows, columns) in mm and mrad."""
    states = [calibration.nominal_fit.state, *(step.state for step in calibration.fit.history)]
    return 1e3 * np.array([calibration.problem.offsets(state) for state in states])


def workspace_chart(workspace: Workspace) -> Chart:
    """Which share of the workspace has a tip error below a value."""
    found = (("nominal", workspace.before, NOMINAL), ("calibrated", workspace.after, CALIBRATED))
    share = np.linspace(0.0, 100.0, len(workspace.tip))
    marks = [Lines(name, 1e3 * np.sort(error), share, color) for name, error, color in found]
    title = "% of the workspace with a tip error below x mm (blue: as drawn, green: calibrated)"
    x = Scale.holding(1e3 * workspace.before, 1e3 * workspace.after, logarithmic=True)
    return Chart("shares", title, x, Scale(0.0, 100.0), marks)
