"""The curves of a recording: residuals by pose, and how the solver got there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from urdfcal.output.charts import parameter_paths
from urdfcal.output.palette import CALIBRATED, NOMINAL, PARAMETER_COLORS
from urdfcal.output.scene import UNITS, rms_by_pose
from urdfcal.output.stream import ITERATION

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.output.scene import Scene
    from urdfcal.output.stream import Layer
    from urdfcal.pipeline import FittedCalibration


def log_residuals(base: Layer, scene: Scene) -> None:
    """Log the rms residual of every pose before and after, in px or mm, without the sightings taken out of the fit."""
    for table in scene.tables:
        unit, scale = UNITS[table.measured.shape[1]]
        used = ~table.outlier
        for name, predicted, color in (
            ("nominal", table.nominal, NOMINAL),
            ("calibrated", table.predicted, CALIBRATED),
        ):
            pose, rms = rms_by_pose(table.pose[used], scale * (predicted - table.measured)[used])
            plot = base.at("plots", f"residual_{unit}", name)
            plot.fixed(rr.SeriesLines(colors=color, names=f"{name} [{unit}]", widths=1.5))
            plot.each(rr.Scalars.columns(scalars=rms), pose)


def log_convergence(base: Layer, calibration: FittedCalibration) -> None:
    """Log cost, damping, step, the rms residual (from the nominal arm's on) and every parameter, step by step.

    A parameter comes with its final value minus and plus one standard deviation. [mm, mrad]
    """
    history = calibration.fit.history
    plots = base.at("plots")
    for name, values in (
        ("cost", [step.cost for step in history]),
        ("damping", [step.damping for step in history]),
        ("step", [step.step for step in history]),
    ):
        _log_iterations(plots.at(name), 1, np.array(values))
    states = [calibration.nominal_fit.state, *(step.state for step in history)]
    for block, outlier in zip(calibration.observations, calibration.fit.outlier, strict=True):
        unit, scale = UNITS[block.dimension]
        used = block.valid & ~outlier
        residuals = [calibration.problem.residual(block, state)[used] for state in states]
        rms = scale * np.sqrt([np.mean(np.sum(r**2, axis=1)) for r in residuals])
        _log_iterations(plots.at(f"rms_{unit}"), 0, rms)
    paths, sigmas = parameter_paths(calibration), 1e3 * calibration.sigmas()
    for i, joint in enumerate(calibration.geometry.labels):
        for k, name in enumerate(calibration.geometry.columns):
            if np.isfinite(sigmas[i, k]):
                band = np.repeat([paths[-1, i, k] + sigmas[i, k] * np.array([-1.0, 1.0])], len(paths), axis=0)
                color = PARAMETER_COLORS[name]
                series = rr.SeriesLines(
                    colors=[color] * 3, widths=[2.0, 0.7, 0.7], names=[name, f"{name} - sigma", f"{name} + sigma"]
                )
                _log_iterations(plots.at("parameters", joint, name), 0, np.column_stack([paths[:, i, k], band]), series)


def _log_iterations(plot: Layer, first: int, values: Floats, series: rr.SeriesLines | None = None) -> None:
    plot.fixed(series or rr.SeriesLines(colors=CALIBRATED))
    rows = rr.TimeColumn(ITERATION, sequence=np.arange(first, first + len(values)))
    columns = rr.Scalars.columns(scalars=values.ravel())
    if values.ndim == 2:
        columns = columns.partition([values.shape[1]] * len(values))
    rr.send_columns(plot.path, [rows], columns, recording=plot.stream)
