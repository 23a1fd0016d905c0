"""What pages and views read of a calibration, as plain arrays: the one place that knows the estimate from inside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.linearize import predict

if TYPE_CHECKING:
    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.cameras.camera import Camera
    from urdfcal.estimation.state import State
    from urdfcal.pipeline import FittedCalibration

LENGTHS = ("d", "a", "x", "y", "z")
"""Parameters in m; the others are in rad."""


@dataclass(frozen=True, eq=False)
class ArmEstimate:
    """Robot, LEDs and cameras as one state of the estimate has them.

    Attributes:
        placements: (n, 4, 4) of the joints. [m]
        offsets: (rows, columns) of what was estimated of the arm. [rad, m]
        row_offsets: (R, 5) of the DH rows; zero where whole placements were estimated. [rad, m]
        T_world_base: (4, 4) the base link in the world. [m]
        leds: (L, 3) LEDs, each in the frame of what it is fastened to. [m]
        cameras: the lenses; none where points were measured.
        T_cam_frame: (C, 4, 4) in each camera the frame it is fixed in: the world, or its link. [m]
    """

    placements: Floats
    offsets: Floats
    row_offsets: Floats
    T_world_base: Floats
    leds: Floats
    cameras: tuple[Camera, ...]
    T_cam_frame: Floats


def calibrated(calibration: FittedCalibration) -> ArmEstimate:
    """The calibrated arm, LEDs and cameras."""
    return _plain(calibration, calibration.estimate)


def nominal(calibration: FittedCalibration, *, same_cameras: bool = False) -> ArmEstimate:
    """The nominal arm, placed to fit the measurements best.

    Args:
        calibration: the result.
        same_cameras: with the calibrated arm's lenses instead of the given ones.
    """
    return _plain(calibration, calibration.comparison.drawn.fit.state if same_cameras else calibration.nominal)


def _plain(calibration: FittedCalibration, state: State) -> ArmEstimate:
    geometry, table = calibration.geometry, calibration.table
    return ArmEstimate(
        placements=geometry.placements(state.offsets),
        offsets=state.offsets,
        row_offsets=state.offsets if geometry is table else np.zeros_like(table.nominal),
        T_world_base=state.T_world_base,
        leds=state.leds,
        cameras=state.cameras,
        T_cam_frame=state.T_cam_world,
    )


def entries_of_rows(calibration: FittedCalibration) -> list[tuple[int, int]]:
    """The entries (row, column) of the arm's offsets that were to be estimated; of some no sigma can be given."""
    columns = calibration.geometry.columns
    return [(row, columns.index(name)) for row, name in calibration.fit.parameters.rows]


def far_corrections(calibration: FittedCalibration, tolerances: float) -> int:
    """Count the corrections of more than so many tolerances; joints' zeros may be anywhere."""
    parameters, offsets = calibration.fit.parameters, calibration.estimate.offsets
    moved = np.array([offsets[entry] for entry in entries_of_rows(calibration)])
    count = len(moved)
    far = parameters.active[:count] & (np.abs(moved) > tolerances * parameters.prior[:count])
    far[list(parameters.zeros)] = False
    return int(np.count_nonzero(far))


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements of one kind as a table, one row each, ordered by pose.

    Attributes:
        unit: of residuals: px for pixels, mm for points.
        scale: what residuals are multiplied by to be in that unit.
        in_space: whether they are points in the world (D = 3), not pixels of a camera (D = 2).
        pose: (S,) index of the pose.
        led: (S,) index of the LED.
        camera: (S,) index of the camera; -1 for points.
        measured: (S, D) in px of the camera, or m in the world.
        sigma: (S,) standard deviation of each component.
        predicted: (S, D) by the calibrated arm.
        nominal: (S, D) by the nominal arm.
        size: (S,) rms of the whitened residual's components after calibration: about 1 where the noise is as declared.
        size_nominal: (S,) the same for the nominal arm.
        outlier: (S,) whether it was taken out of the fit.
    """

    unit: str
    scale: float
    in_space: bool
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
    def components(self) -> str:
        """The letter of each component."""
        return "xyz" if self.in_space else "uv"

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


def measurements_of(calibration: FittedCalibration) -> tuple[Measurements, ...]:
    """Bring the calibration's blocks of observations, and what became of them, into tables."""
    fit, tables = calibration.fit, []
    for index, block in enumerate(calibration.observations):
        rows, pixels = block.valid, block.dimension == 2
        size, size_nominal = (
            solution.deviation[index][rows] / np.sqrt(block.dimension) for solution in (fit, calibration.nominal_fit)
        )
        tables.append(
            Measurements(
                unit="px" if pixels else "mm",
                scale=1.0 if pixels else 1e3,
                in_space=not pixels,
                pose=np.broadcast_to(block.pose[:, None], rows.shape)[rows],
                led=block.led[rows],
                camera=block.camera[rows],
                measured=block.value[rows],
                sigma=np.sqrt(block.covariance[rows][:, 0, 0]),
                predicted=predict(calibration.geometry, block, calibration.estimate)[rows],
                nominal=predict(calibration.geometry, block, calibration.nominal)[rows],
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
    return Convergence(cost, damping, step, 1e3 * np.array([state.offsets for state in _states(calibration)]))


def rms_by_iteration(calibration: FittedCalibration, tables: tuple[Measurements, ...]) -> dict[str, Floats]:
    """The rms residual (I + 1,) at the nominal arm and after each step, by unit, outliers left out."""
    result = {}
    for block, outlier, table in zip(calibration.observations, calibration.fit.outlier, tables, strict=True):
        used = block.valid & ~outlier
        residuals = ((predict(calibration.geometry, block, s) - block.value)[used] for s in _states(calibration))
        result[table.unit] = table.scale * np.sqrt([np.mean(np.sum(r**2, axis=1)) for r in residuals])
    return result


def _states(calibration: FittedCalibration) -> list[State]:
    return [calibration.nominal, *(step.state for step in calibration.fit.history)]
