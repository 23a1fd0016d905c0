"""The charts of report and recording: residuals and what they might depend on, parameters, convergence, workspace."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import evenly
from urdfcal.estimation.blocks.arm import LENGTHS, ArmBlock
from urdfcal.output import palette
from urdfcal.output.chart import Chart, Mark, Scale, bars
from urdfcal.output.joint_charts import contribution_chart, joint_model_charts
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.output.findings import Overview
    from urdfcal.output.scene import ResidualTable
    from urdfcal.output.workspace import Workspace
    from urdfcal.result.fitted import FittedCalibration

# Residuals in standard deviations beyond this are off the charts.
_SIGMAS = 6.0
_BINS = 8
# So many dots side by side, and over each other, are told apart.
_DOTS, _MANY = 250, 600
# A joint that moves less than this tells nothing. [rad, m]
_AT_REST = 1e-6
SYMBOLS = {"theta": "\u03b8", "alpha": "\u03b1", "beta": "\u03b2"}

_COURSES = {"cost": "cost", "damping": "damping", "step": "step [std. dev.]"}


def all_charts(overview: Overview) -> list[Chart]:
    """Every chart of a recording."""
    return [
        *residual_charts(overview),
        *joint_charts(overview.calibration),
        *parameter_charts(overview.calibration),
        *convergence_charts(overview.calibration),
        *workspace_charts(overview.workspaces),
    ]


def joint_charts(calibration: FittedCalibration) -> list[Chart]:
    """What was wrong with the arm by joint, and each joint model that was estimated."""
    by_cause = contribution_chart(calibration)
    return [*([] if by_cause is None else [by_cause]), *joint_model_charts(calibration)]


def residual_charts(overview: Overview) -> list[Chart]:
    """Residuals by pose and camera, against the declared noise, the distance, and every joint."""
    scene, calibration, table = overview.scene, overview.calibration, overview.scene.tables[0]
    charts = [by_pose(table, frame_times(calibration)), spread(table)]
    if scene.pixels is not None:
        charts.insert(1, _by_camera(scene.pixels, [camera.name for camera in calibration.estimate.cameras]))
        distance = np.linalg.norm(scene.rays[:, 1] - scene.rays[:, 0], axis=1)
        charts.append(_against("distance", "camera distance [m]", distance, scene.pixels))
    for j, joint in enumerate(calibration.chain.joints):
        unit = "m" if joint.prismatic else "rad"
        value = calibration.session.q[table.pose, j]
        if np.ptp(value) < _AT_REST:
            continue
        charts.append(_against(f"joint {j + 1}", f"{joint.name} [{unit}]", value, table))
    return charts


def frame_times(calibration: FittedCalibration) -> Floats | None:
    """When each frame (N,) of an arm that moved was taken; None where it stood still in poses. [s]."""
    session = calibration.session
    return session.time if isinstance(session.motion, Trajectory) else None


def by_pose(table: ResidualTable, times: Floats | None = None) -> Chart:
    """The rms residual of each pose, nominal and calibrated; of an arm that moved over its frames' times (N,), in s."""
    # Thousands would be a carpet: so many are one dot.
    if times is None:
        run = 1 + int(table.pose.max(initial=0)) // _DOTS
        part, step, first, label = table.pose // run, float(run), 1 + (run - 1) / 2, "pose"
        title = f"rms of {'each pose' if run == 1 else f'{run} poses each'} [{table.unit}]"
    else:
        step = max(float(np.ptp(times)), 1e-3) / _DOTS
        part = ((times[table.pose] - times.min()) // step).astype(np.intp)
        run = round(len(np.unique(table.pose)) / len(np.unique(part)))
        first, label = float(times.min()) + step / 2, "time [s]"
        title = f"rms of {'each frame' if run == 1 else f'about {run} frames each'} [{table.unit}]"
    rms = {name: table.rms_by(part, predicted) for name, predicted in table.by_arm.items()}
    at = first + step * rms["nominal"][0]
    x = Scale.holding(at, whole=times is None)
    return Chart(
        "by pose",
        title,
        x,
        Scale.holding(*(of_pose for _, of_pose in rms.values()), table.noise, logarithmic=True),
        [
            Mark("lines", "declared", [x.low, x.high], [table.noise, table.noise], palette.INK),
            *(Mark("dots", name, at, of_pose, palette.OF_ARM[name]) for name, (_, of_pose) in rms.items()),
        ],
        x_label=label,
        legend=("nominal", "calibrated", "declared"),
        breadth=3.0,
    )


def _by_camera(pixels: ResidualTable, names: list[str]) -> Chart:
    marks, tallest = [], 0.0
    for side, (name, predicted) in zip((-0.15, 0.15), pixels.by_arm.items(), strict=True):
        camera, rms = pixels.rms_by(pixels.camera, predicted)
        marks.append(Mark("bars", name, *bars(side + camera.astype(float), rms, 0.1), palette.OF_ARM[name]))
        tallest = max(tallest, float(np.nanmax(rms, initial=0.0)))
    return Chart(
        "by camera",
        "By camera [px]",
        Scale(-0.7, len(names) - 0.3, names={float(c): name for c, name in enumerate(names)}),
        Scale(0.0, 1.1 * tallest),
        marks,
    )


def spread(table: ResidualTable) -> Chart:
    """How the residuals are distributed, beside the normal distribution that was declared."""
    edges, x = np.linspace(-_SIGMAS, _SIGMAS, 49), np.linspace(-_SIGMAS, _SIGMAS, 121)
    bell = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    marks = [Mark("lines", "declared", x, bell, palette.INK)]
    tallest, label = float(bell.max()), "residual / noise"
    for name, predicted in table.by_arm.items():
        sigmas = table.sigmas(predicted).ravel()
        share = np.histogram(sigmas, edges)[0] / max(len(sigmas), 1) / np.diff(edges)
        marks.append(Mark("lines", name, np.repeat(edges, 2)[1:-1], np.repeat(share, 2), palette.OF_ARM[name]))
        tallest = max(tallest, float(share.max()))
        beyond = 100.0 * np.mean(~(np.abs(sigmas) <= _SIGMAS)) if len(sigmas) else 0.0
        label += f" ({beyond:.0f} % of {name} beyond)" if beyond >= 0.5 else ""
    return Chart(
        "spread",
        "Density of residuals",
        Scale(-_SIGMAS, _SIGMAS),
        Scale(0.0, 1.1 * tallest),
        marks,
        x_label=label,
        breadth=2.0,
    )


def _against(name: str, title: str, value: Floats, table: ResidualTable) -> Chart:
    """Residuals over something they should not depend on, and the means of bins of equal number."""
    known = np.isfinite(value[table.used])
    value, sigmas = value[table.used][known], table.sigmas(table.predicted)[known]
    bins = np.array_split(np.argsort(value, kind="stable"), min(_BINS, max(1, len(value) // 5)))
    centre = [np.mean(value[b]) for b in bins]
    components = range(sigmas.shape[1])
    faint = [tuple(c // 2 for c in color) for color in palette.COMPONENTS]
    some = evenly(np.arange(len(value)), _MANY)
    marks = [Mark("dots", f"component {k}", value[some], sigmas[some, k], faint[k]) for k in components]
    means = [[np.mean(sigmas[b, k]) for b in bins] for k in components]
    marks += [Mark("lines", f"mean {k}", centre, means[k], palette.COMPONENTS[k]) for k in components]
    reach = float(np.clip(np.nanpercentile(np.abs(sigmas), 99), 3.0, 100.0))
    y = Scale(-reach, reach)
    return Chart(name, title, Scale.holding(value), y, marks)


def parameter_charts(calibration: FittedCalibration) -> list[Chart]:
    """Corrections of the arm's rows as bars with their 95 % intervals and tolerances, lengths and angles apart."""
    offsets, sigmas = 1e3 * calibration.estimate.offsets, 1e3 * calibration.sigmas()
    tolerances = 1e3 * row_tolerances(calibration)
    columns, labels = calibration.geometry.columns, calibration.geometry.labels
    charts = []
    for kind, unit in (("lengths", "mm"), ("angles", "mrad")):
        of_kind = np.isfinite(sigmas) & [(name in LENGTHS) == (unit == "mm") for name in columns]
        if not of_kind.any():
            continue
        value, margin = offsets[of_kind], 1.96 * sigmas[of_kind]
        y = np.arange(len(value), 0.0, -1.0)
        ends = np.stack([value - margin, value + margin], axis=-1)
        across, along = bars(y, value, 0.25)
        names = [f"{labels[row]} {SYMBOLS.get(columns[k], columns[k])}" for row, k in np.argwhere(of_kind)]
        height = Scale(0.2, len(value) + 0.8, names=dict(zip(y.tolist(), names, strict=True)))
        sides = np.concatenate([-tolerances[of_kind], tolerances[of_kind]])
        both, known = np.concatenate([y, y]), np.isfinite(sides)
        brackets = np.stack([sides, sides], axis=-1)[known], both[known, None] + [-0.4, 0.4]
        charts.append(
            Chart(
                kind,
                f"{kind} [{unit}]",
                Scale.holding(ends, brackets[0], 0.0),
                height,
                [
                    Mark("bars", "offsets", along, across, palette.CALIBRATED),
                    Mark("lines", "intervals", ends, np.stack([y, y], axis=-1), palette.INK),
                    Mark("hairlines", "zero", [0.0, 0.0], [height.low, height.high], palette.INK),
                    Mark("lines", "tolerances", *brackets, palette.ACCENT),
                ],
            )
        )
    return charts


def row_tolerances(calibration: FittedCalibration) -> Floats:
    """The tolerances (rows, columns) that the estimate has as priors, in rad and m; NaN where it has none."""
    result = np.full(calibration.estimate.offsets.shape, np.nan)
    parameters = calibration.fit.parameters
    for block in parameters.blocks:
        if isinstance(block, ArmBlock):
            sigma = np.array(parameters.prior[parameters.columns(block.key)])
            sigma[~np.isfinite(sigma)] = np.nan
            result[block.places] = sigma
    return result


def paths(calibration: FittedCalibration) -> Floats:
    """The arm's offsets (I + 1, rows, columns) at the nominal arm and after each step of the solver. [mrad, mm]."""
    return 1e3 * np.array([calibration.problem.offsets(state) for state in calibration.states])


def convergence_charts(calibration: FittedCalibration) -> list[Chart]:
    """Cost, damping and step of every iteration, and how each joint's parameters converged."""
    charts, history, courses = [], calibration.fit.history, paths(calibration)
    number = np.arange(0.0, len(courses))
    for name, title in _COURSES.items():
        # The nominal arm has a cost, and comes before the first step.
        values = np.array([getattr(step, name) for step in history])
        values = np.append(calibration.nominal_fit.cost if name == "cost" else np.nan, values)
        line = Mark("lines", "line", number, values, palette.CALIBRATED)
        marks = [line, replace(line, kind="dots", name="dots")]
        x, y = Scale.holding(number, whole=True), Scale.holding(values, logarithmic=True)
        charts.append(Chart(name, title, x, y, marks, x_label="iteration"))
    sigmas, columns = 1e3 * calibration.sigmas(), calibration.geometry.columns
    for i, joint in enumerate(calibration.geometry.labels):
        marks = []
        for k in np.flatnonzero(np.isfinite(sigmas[i])):
            color = palette.PARAMETER_COLORS[columns[k]]
            band = np.repeat(courses[-1, i, k] + sigmas[i, k] * np.array([[-1.0], [1.0]]), 2, axis=1)
            marks.append(Mark("hairlines", f"{columns[k]} band", [[number[0], number[-1]]] * 2, band, color))
            marks.append(Mark("lines", columns[k], number, courses[:, i, k], color))
        if marks:
            y = Scale.holding(*(mark.y for mark in marks))
            x = Scale.holding(number, whole=True)
            charts.append(Chart(f"path of {joint}", joint, x, y, marks, x_label="iteration"))
    return charts


def workspace_charts(workspaces: Sequence[Workspace]) -> list[Chart]:
    """The share of each arm's workspace that has a tip error below a value, in one range of errors.

    The first stands beside what the colours of the recording's clouds stand for.
    """
    errors = Scale.holding(*(1e3 * error for of in workspaces for error in of.errors.values()), logarithmic=True)
    share = np.linspace(0.0, 100.0, len(workspaces[0].tip))
    return [
        Chart(
            f"shares {k + 1}" if k else "shares",
            f"{of.link}: % below" if len(workspaces) > 1 else "% of the workspace below",
            errors,
            Scale(0.0, 100.0),
            [
                Mark("lines", name, 1e3 * np.sort(error), share, palette.OF_ARM.get(name, palette.ACCENT))
                for name, error in of.errors.items()
            ],
            x_label="distance, standard deviation [mm]",
            legend=tuple(of.errors),
            colors=None if k else error_colors(workspaces),
        )
        for k, of in enumerate(workspaces)
    ]


def error_colors(workspaces: Sequence[Workspace]) -> Scale:
    """What the colours of tip errors stand for, nominal and calibrated and of every arm alike. [mm]."""
    least, largest = (
        1e3 * end for end in (min(of.range[0] for of in workspaces), max(of.range[1] for of in workspaces))
    )
    smallest = max(least, 1e-6)  # below a nanometre an error is none
    return Scale(smallest, max(largest, 2.0 * smallest), logarithmic=True)
