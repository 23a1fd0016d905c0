"""The curves of a recording: residuals by pose, and how the solver got there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from urdfcal.estimation.residuals import predict
from urdfcal.output.palette import CALIBRATED, NOMINAL
from urdfcal.output.stream import ITERATION

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.calibration import Calibration
    from urdfcal.output.scene import Scene
    from urdfcal.output.stream import Layer

_UNITS = {2: ("px", 1.0), 3: ("mm", 1e3)}


def log_residuals(base: Layer, scene: Scene) -> None:
    """Log the rms residual of every pose before and after, in px or mm, without the sightings taken out of the fit."""
    for table in scene.tables:
        unit, scale = _UNITS[table.measured.shape[1]]
        used = ~table.outlier
        for name, predicted, color in (
            ("nominal", table.nominal, NOMINAL),
            ("calibrated", table.predicted, CALIBRATED),
        ):
            pose, rms = rms_by_pose(table.pose[used], scale * (predicted - table.measured)[used])
            plot = base.at("plots", f"residual_{unit}", name)
            plot.fixed(rr.SeriesLines(colors=color, names=f"{name} [{unit}]", widths=1.5))
            plot.each(rr.Scalars.columns(scalars=rms), pose)


def log_convergence(base: Layer, calibration: Calibration) -> None:
    """Log the solver's cost after every step, and the rms residual, starting with the nominal arm's."""
    history = calibration.fit.history
    states = [calibration.nominal, *(iteration.state for iteration in history)]
    _log_iterations(base.at("plots", "cost"), 1, np.array([iteration.cost for iteration in history]))
    for block, outlier in zip(calibration.observations, calibration.fit.outlier, strict=True):
        unit, scale = _UNITS[block.dimension]
        used = block.valid & ~outlier
        residuals = [(predict(calibration.geometry, block, state) - block.value)[used] for state in states]
        rms = scale * np.sqrt([np.mean(np.sum(r**2, axis=1)) for r in residuals])
        _log_iterations(base.at("plots", f"rms_{unit}"), 0, rms)


def _log_iterations(plot: Layer, first: int, values: Floats) -> None:
    number = np.arange(first, first + len(values))
    plot.fixed(rr.SeriesLines(colors=CALIBRATED))
    rows = rr.TimeColumn(ITERATION, sequence=number)
    rr.send_columns(plot.path, [rows], rr.Scalars.columns(scalars=values), recording=plot.stream)
    # A time series shows nothing while another timeline is chosen; bars do.
    plot.at("bars").fixed(rr.BarChart(values, abscissa=number, color=CALIBRATED))


def rms_by_pose(pose: Ints, residuals: Floats) -> tuple[Ints, Floats]:
    """Root mean square length of the residuals (S, D) of each pose that has any."""
    count = np.bincount(pose)
    total = np.bincount(pose, np.sum(residuals**2, axis=1))
    poses = np.flatnonzero(count)
    return poses, np.sqrt(total[poses] / count[poses])
