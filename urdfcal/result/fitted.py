"""A calibration with the session and the estimate that it came from; its corrected URDF, read again and compared."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import CalibrationError, OutputError
from urdfcal.estimation.blocks.arm import ARM, ArmBlock, ArmParameterization, zero_rows
from urdfcal.estimation.joint_models.base import Readings
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.joint_models.zero_offset import ZERO_OFFSETS
from urdfcal.estimation.snapshot import Snapshot
from urdfcal.estimation.uncertainty import expecting, tip_covariance
from urdfcal.result.calibration import Calibration, corrected_name
from urdfcal.robot.chain import Chain, read_mechanism
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from urdfcal.estimation.assessment import Assessment
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
    from urdfcal.robot.mechanism import Mechanism, Tip
    from urdfcal.session.model import Session

# Forward kinematics of the URDF that was written against the estimate. [m, entries of the rotation]
_AGREEMENT = 1e-9
_CHECK_POSES = 20


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
    assessment: Assessment = field()  # the inherited one is no default

    @property
    def nominal_fit(self) -> Solution:
        """The nominal arm and lenses, with base, LEDs and unknown camera poses fitted."""
        return self.comparison.nominal

    @property
    def fit(self) -> Solution:
        """The chosen model's estimate."""
        return self.comparison.chosen.fit

    @property
    def is_arm_estimated(self) -> bool:
        """Whether anything of the arm was estimated: of one that was not nothing is known but what it should be."""
        models = (m.key for m in self.problem.joint_models if isinstance(m, LinearJointModel))
        return any(self.fit.parameters.has_active(key) for key in (ARM, ZERO_OFFSETS, *models))

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

    @property
    def states(self) -> list[State]:
        """The solver's way: the nominal arm, and what each of its steps came to."""
        return [self.nominal_fit.state, *(step.state for step in self.fit.history)]

    @cached_property
    def true_q(self) -> Floats:
        """(N, n) true joint values of the session's poses, of the problem's mechanism. [rad or m]."""
        readings, state = Readings.of(self.session), self.fit.state
        q = readings.q
        for model in self.problem.joint_models:
            if isinstance(model, LinearJointModel) and model.key in state:
                q = q + model.values(readings, state[model.key])
        return frozen(q)

    @cached_property
    def nominal(self) -> Snapshot:
        """The nominal arm, with everything else fitted."""
        return self.snapshot(self.nominal_fit.state)

    @cached_property
    def estimate(self) -> Snapshot:
        """The calibrated arm, LEDs and cameras."""
        return self.snapshot(self.fit.state)

    @cached_property
    def chain(self) -> Mechanism:
        """The nominal joints that were calibrated."""
        return self.table.chain

    @cached_property
    def placements(self) -> Floats:
        """(n, 4, 4) calibrated placement of each joint in the frame of its parent joint. [m]."""
        return frozen(self.geometry.placements(self.estimate.offsets))

    @cached_property
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

    def tip_sigma(self, q: Floats, tip: Tip | None = None) -> Floats:
        """Predict the standard deviation of the calibrated tip's position, after base alignment.

        It is what is to be expected, as the tip's error over the workspace, and not what may be wrong as well.

        Args:
            q: (N, n) joint values. [rad or m]
            tip: another link than the first tip.

        Returns:
            (N,) root of the covariance's trace. [m]
        """
        covariance = tip_covariance(self.problem, expecting(self.fit), q, tip=tip)
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
        if self.session.urdf is None:
            raise OutputError("the session was built without a URDF", remedy="Use Calibration.apply on the model.")
        data = self.apply_to_urdf(self.session.urdf)
        chain, table = self.chain, self.table
        q = chain.random_values(_CHECK_POSES, np.random.default_rng(self.seed))
        expected = np.array(link_poses(chain, q, chain.tips, self.placements))
        again = read_mechanism(Urdf.parse(data), [tip.link for tip in chain.tips], chain.base_link)
        tips = {"Pinocchio": np.array(link_poses(again, q, again.tips)), "yourdfpy": _yourdfpy_links(data, chain, q)}
        if self.geometry is table and isinstance(chain, Chain):
            tips["the DH rows"] = np.array([[table.forward(q_k, self.estimate.offsets) for q_k in q]])
        for reader, T in tips.items():
            error = float(np.abs(T - expected).max())
            if not error <= _AGREEMENT:
                raise OutputError(
                    f"the corrected URDF moves differently when read by {reader}: {error:.1e} m or in the rotation",
                    where=self.session.urdf_reference,
                    remedy="This is a defect of urdfcal; please report it with the URDF.",
                )
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


def _yourdfpy_links(data: bytes, chain: Mechanism, q: Floats) -> Floats:
    """T_base_link (tips, N, 4, 4) by yourdfpy, which shares no code with Pinocchio."""
    import yourdfpy

    robot = yourdfpy.URDF.load(io.BytesIO(data), load_meshes=False, build_scene_graph=True)
    for joint in robot.joint_map.values():  # it takes a sliding joint's axis as long as it is written
        if joint.axis is not None and np.any(joint.axis):
            joint.axis = np.asarray(joint.axis) / np.linalg.norm(joint.axis)
    names = [joint.name for joint in robot.actuated_joints]
    result = np.empty((len(chain.tips), len(q), 4, 4))
    for k, q_k in enumerate(q):
        values = dict(zip(chain.names, q_k, strict=True))
        robot.update_cfg([values.get(name, 0.0) for name in names])
        for i, tip in enumerate(chain.tips):
            result[i, k] = robot.get_transform(tip.link, chain.base_link)
    return result
