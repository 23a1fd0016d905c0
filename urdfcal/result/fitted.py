"""A calibration with the session and the estimate that it came from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import CalibrationError, OutputError
from urdfcal.estimation.blocks.arm import ArmBlock, zero_rows
from urdfcal.estimation.joint_models.zero_offset import ZERO_OFFSETS
from urdfcal.estimation.snapshot import Snapshot
from urdfcal.estimation.uncertainty import tip_covariance
from urdfcal.result.calibration import Calibration, corrected_name

if TYPE_CHECKING:
    from urdfcal.estimation.assessment import Assessment
    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.estimation.evidence import Evidence
    from urdfcal.estimation.identifiability import Identifiability
    from urdfcal.estimation.model_selection import Comparison
    from urdfcal.estimation.multistart import Minimum
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution
    from urdfcal.estimation.state import Key, State
    from urdfcal.result.document import ResultDocument
    from urdfcal.robot.dh import DHTable
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False, repr=False)
class FittedCalibration(Calibration):
    """A calibration with the session and the estimate that it came from.

    Attributes:
        session: what was measured; of an arm that moved, joint values at the estimated time offsets.
        table: the nominal DH rows.
        problem: the arm's parameters and the measurements, in the order that the solutions' norms follow.
        comparison: the models that were tried, and the chosen one.
        solutions: minima reached from other starts, if any were asked for; the kept one first.
        seed: random seed of the folds and of the check configurations.
        evidence: on the chosen model, beside its residuals.
        assessment: whether to trust the result, and what speaks against it.
    """

    session: Session
    table: DHTable
    problem: Problem
    comparison: Comparison
    solutions: tuple[Minimum, ...]
    seed: int
    evidence: Evidence
    assessment: Assessment

    @property
    def nominal_fit(self) -> Solution:
        """The nominal arm and lenses, with base, LEDs and unknown camera poses fitted."""
        return self.comparison.nominal

    @property
    def fit(self) -> Solution:
        """The chosen model's estimate."""
        return self.comparison.chosen.fit

    @property
    def identifiability(self) -> Identifiability:
        """What the measurements identify, and which directions are unidentifiable."""
        return self.comparison.chosen.identifiability

    @property
    def geometry(self) -> ArmParameterization:
        """What was estimated of the arm: the offsets of the DH rows, or of whole placements."""
        return self.problem.arm

    @property
    def observations(self) -> tuple[Observations, ...]:
        """The session's measurements, arranged by pose."""
        return self.problem.observations

    def snapshot(self, state: State) -> Snapshot:
        """Return the values of a state under plain names."""
        return Snapshot.of(self.problem, state)

    @cached_property
    def nominal(self) -> Snapshot:
        """The nominal arm, with everything else fitted."""
        return self.snapshot(self.nominal_fit.state)

    @cached_property
    def estimate(self) -> Snapshot:
        """The calibrated arm, LEDs and cameras."""
        return self.snapshot(self.fit.state)

    @property
    def chain(self) -> Mechanism:
        """The nominal joints that were calibrated."""
        return self.table.chain

    @cached_property
    def placements(self) -> Floats:
        """(n, 4, 4) calibrated placement of each joint in the frame of its parent joint. [m]."""
        return frozen(self.geometry.placements(self.estimate.offsets))

    @property
    def dh_offsets(self) -> Floats | None:
        """(rows, 5) added to the DH rows, columns as ``dh.PARAMETERS`` [rad, m]; None for whole placements."""
        return self.estimate.offsets if self.geometry is self.table else None

    @cached_property
    def document(self) -> ResultDocument:
        """Everything the calibration says: what ``calibration.json`` holds.

        Raises:
            CalibrationError: it is so far off that not even its errors are numbers.
        """
        from pydantic import ValidationError

        from urdfcal.result.builder import build_document

        try:
            return build_document(self)
        except ValidationError as error:
            key = ".".join(map(str, error.errors()[0]["loc"]))
            what = f"{'; '.join(self.failures)}; there is no result to write: {key} is no finite number"
            raise CalibrationError(what, where="not written") from error

    def tip_sigma(self, q: Floats) -> Floats:
        """Predict the standard deviation of the calibrated tip's position, after base alignment.

        Args:
            q: (N, n) joint values. [rad or m]

        Returns:
            (N,) root of the covariance's trace. [m]
        """
        covariance = tip_covariance(self.problem, self.fit, q)
        result: Floats = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        return result

    @property
    def urdf_name(self) -> str:
        """File name of the corrected URDF."""
        return corrected_name(self.session.urdf_reference)

    def calibrated_urdf(self) -> bytes:
        """Return the session's URDF with the calibrated joint origins, nothing else changed.

        Raises:
            OutputError: the session has no URDF, or the result, read again by Pinocchio and by yourdfpy,
                does not move as the estimate does.
        """
        from urdfcal.result.verification import verify_urdf

        urdf = self.session.urdf
        if urdf is None:
            raise OutputError("the session was built without a URDF", remedy="Use Calibration.apply on the model.")
        data = self.apply_to_urdf(urdf)
        verify_urdf(data, self)
        return data

    def sigmas(self) -> Floats:
        """Return the standard deviations of the estimate's offsets, in rad and m; NaN where one was not estimated."""
        result = np.full(self.estimate.offsets.shape, np.nan)
        for block in self.fit.parameters.blocks:
            if isinstance(block, ArmBlock):
                result[block.places] = self.sigmas_of(block.key)
            elif block.key == ZERO_OFFSETS:
                for place, value in zip(zero_rows(self.geometry).values(), self.sigmas_of(block.key), strict=True):
                    result[place] = value
        return result

    @property
    def corrected(self) -> tuple[tuple[int, str], ...]:
        """(row, parameter) of the arm that were estimated."""
        rows, columns = np.nonzero(np.isfinite(self.sigmas()))
        return tuple((int(row), self.geometry.columns[k]) for row, k in zip(rows, columns, strict=True))

    def sigmas_of(self, key: Key[Any]) -> Floats:
        """Return the standard deviations (k,) of a block's coordinates, NaN where fixed; (0,) of one that has no part.

        Args:
            key: of the block.
        """
        return self._sigma[self.fit.parameters.columns(key)]

    @cached_property
    def _sigma(self) -> Floats:
        """Standard deviation of every entry of the full parameter vector; NaN where it is fixed."""
        return self.fit.parameters.sigmas(self.fit.covariance)
