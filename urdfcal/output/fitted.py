"""What pages and views read of a calibration, as plain arrays: the one place that knows the estimate from inside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.snapshot import Snapshot

if TYPE_CHECKING:
    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.state import State
    from urdfcal.result.fitted import FittedCalibration


@dataclass(frozen=True, eq=False)
class ArmEstimate(Snapshot):
    """Robot, LEDs and cameras as one state of the estimate has them, and what follows for the joints.

    Attributes:
        placements: (n, 4, 4) of the joints. [m]
        row_offsets: (R, 5) of the DH rows; zero where whole placements were estimated. [rad, m]
    """

    placements: Floats
    row_offsets: Floats


def calibrated(calibration: FittedCalibration) -> ArmEstimate:
    """The calibrated arm, LEDs and cameras."""
    return _plain(calibration, calibration.estimate)


def nominal(calibration: FittedCalibration, *, same_cameras: bool = False) -> ArmEstimate:
    """The nominal arm, placed to fit the measurements best.

    Args:
        calibration: the result.
        same_cameras: with the calibrated arm's lenses instead of the given ones.
    """
    other = calibration.comparison.nominal_arm.fit.state
    return _plain(calibration, calibration.snapshot(other) if same_cameras else calibration.nominal)


def _plain(calibration: FittedCalibration, state: Snapshot) -> ArmEstimate:
    geometry, table = calibration.geometry, calibration.table
    return ArmEstimate(
        **vars(state),
        placements=geometry.placements(state.offsets),
        row_offsets=state.offsets if geometry is table else np.zeros_like(table.nominal),
    )


def entries_of_rows(calibration: FittedCalibration) -> list[tuple[int, int]]:
    """The entries (row, column) of the arm's offsets that were estimated."""
    return [(row, calibration.geometry.columns.index(name)) for row, name in calibration.corrected]


@dataclass(frozen=True, eq=False)
class ResidualTable:
    """Measurements of one kind and their residuals, one row each, ordered by pose.

    Attributes:
        unit: of residuals: px for pixels, mm for points.
        scale: what residuals are multiplied by to be in that unit.
        components: the name of each component.
        by_camera: whether cameras measured.
        in_world: whether the numbers are a position in the world.
        pose: (S,) index of the pose.
        led: (S,) index of the LED, or behind all of them of the target.
        camera: (S,) index of the camera; -1 for points.
        measured: (S, D) in px of the camera, m in the world, or the kind's own unit.
        sigma: (S,) standard deviation of each component.
        predicted: (S, D) by the calibrated arm.
        nominal: (S, D) by the nominal arm.
        size: (S,) rms of the whitened residual's components after calibration: about 1 where the noise is as declared.
        size_nominal: (S,) the same for the nominal arm.
        outlier: (S,) whether it was taken out of the fit.
    """

    unit: str
    scale: float
    components: tuple[str, ...]
    by_camera: bool
    in_world: bool
    pose: Ints
    led: Ints
    camera: Ints
    measured: Floats
    sigma: Floats
    predicted: Floats
    nominal: Floats
    size: Floats
    size_nominal: Floats
    outlier: Bools

    @property
    def used(self) -> Bools:
        """(S,) whether it took part in the fit."""
        return ~self.outlier

    @property
    def noise(self) -> float:
        """The declared noise as the rms length of a residual, in ``unit``."""
        return float(self.scale * np.sqrt(len(self.components)) * np.median(self.sigma))

    def sigmas(self, predicted: Floats) -> Floats:
        """Residuals (used, D) of a prediction (S, D) in units of the declared noise, outliers left out."""
        return ((predicted - self.measured) / self.sigma[:, None])[self.used]

    def rms_by_pose(self, predicted: Floats) -> tuple[Ints, Floats]:
        """The poses that have residuals, and their root mean square length in ``unit``, outliers left out."""
        square = np.sum((self.scale * (predicted - self.measured)[self.used]) ** 2, axis=1)
        count = np.bincount(self.pose[self.used])
        poses = np.flatnonzero(count)
        return poses, np.sqrt(np.bincount(self.pose[self.used], square)[poses] / count[poses])


def measurements_of(calibration: FittedCalibration) -> tuple[ResidualTable, ...]:
    """Bring the calibration's blocks of observations, and what became of them, into tables."""
    fit, tables, problem = calibration.fit, [], calibration.problem
    for index, block in enumerate(calibration.observations):
        rows, (unit, scale), lengths = block.valid, block.table.report, block.table.lengths
        measured = problem.seen(block, fit.state)[rows]
        bodies = len(calibration.session.led_names) + block.index.get("target", block.row)
        size, size_nominal = (
            solution.norms[index][rows] / np.sqrt(block.dimension) for solution in (fit, calibration.nominal_fit)
        )
        tables.append(
            ResidualTable(
                unit=unit,
                scale=scale,
                components=block.table.components(),
                by_camera="camera" in block.index,
                in_world="camera" not in block.index and measured.shape[1] == 3,
                pose=np.broadcast_to(block.pose[:, None], rows.shape)[rows],
                led=block.index.get("led", bodies)[rows],
                camera=block.index.get("camera", np.full_like(block.row, -1))[rows],
                measured=measured,
                sigma=np.sqrt(block.covariance[rows][:, 0, 0]),
                predicted=measured + problem.residual(block, fit.state)[rows][:, lengths],
                nominal=measured + problem.residual(block, calibration.nominal_fit.state)[rows][:, lengths],
                size=size,
                size_nominal=size_nominal,
                outlier=fit.outlier[index][rows],
            )
        )
    return tuple(tables)


@dataclass(frozen=True, eq=False)
class Convergence:
    """The solver's way from the nominal arm to the estimate in I steps.

    Attributes:
        cost: (I,) after each step.
        damping: (I,) Levenberg-Marquardt's lambda.
        step: (I,) length of each step in standard deviations of the estimate.
        offsets: (I + 1, rows, columns) of the arm, the nominal arm's first. [mrad, mm]
    """

    cost: Floats
    damping: Floats
    step: Floats
    offsets: Floats


def convergence_of(calibration: FittedCalibration) -> Convergence:
    """The solver's steps."""
    history = calibration.fit.history
    cost, damping, step = np.array([(each.cost, each.damping, each.step) for each in history]).reshape(-1, 3).T
    return Convergence(
        cost, damping, step, 1e3 * np.array([calibration.problem.offsets(state) for state in _states(calibration)])
    )


def rms_by_iteration(calibration: FittedCalibration, tables: tuple[ResidualTable, ...]) -> dict[str, Floats]:
    """The rms residual (I + 1,) at the nominal arm and after each step, by unit, outliers left out."""
    result = {}
    for block, outlier, table in zip(calibration.observations, calibration.fit.outlier, tables, strict=True):
        used = block.valid & ~outlier
        residuals = (calibration.problem.residual(block, s)[used] for s in _states(calibration))
        result[table.unit] = table.scale * np.sqrt([np.mean(np.sum(r**2, axis=1)) for r in residuals])
    return result


def _states(calibration: FittedCalibration) -> list[State]:
    return [calibration.nominal_fit.state, *(step.state for step in calibration.fit.history)]
