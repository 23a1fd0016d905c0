"""A calibrated robot, as a motion stack uses it: loaded, applied, compensated for, saved."""

from __future__ import annotations

import hashlib
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal import files
from urdfcal.arrays import Bools, Floats, frozen
from urdfcal.errors import OutputError, RobotError
from urdfcal.robot.apply import apply_to_model, apply_to_urdf
from urdfcal.robot.chain import Chain, Tree
from urdfcal.robot.compensation import Compensation, compensate, compensate_one
from urdfcal.robot.dh import PARAMETERS
from urdfcal.robot.flexure import spread_placements
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.mechanism import BASE, Joint, Mechanism, Tip
from urdfcal.robot.newton import TipAtOnce
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.urdf import Mimic, Urdf
from urdfcal.session.domain import beyond

if TYPE_CHECKING:
    import pinocchio as pin
    from numpy.typing import ArrayLike

    from urdfcal.arrays import Ints
    from urdfcal.estimation.assessment import Assessment
    from urdfcal.estimation.joint_models.found import Carried, FoundJointModels
    from urdfcal.result.document import ResultDocument

FILE_NAME = "calibration.json"

# Encoders read a little beyond a limit; degrees and millimetres are far beyond. [rad or m]
_FAR_OUTSIDE = 0.1


class Calibration:
    """A calibrated robot: its nominal joints, their calibrated placements, and the result document.

    Immutable, so that threads may share it.
    """

    def __init__(self, document: ResultDocument) -> None:
        """Start from everything that a calibration says."""
        self._read = document

    @property
    def document(self) -> ResultDocument:
        """Everything the calibration says: what ``calibration.json`` holds."""
        return self._read

    @cached_property
    def assessment(self) -> Assessment:
        """Whether to trust it, and what speaks against it: the verdict's reasons that are no warnings are failures."""
        from urdfcal.estimation.assessment import Assessment

        verdict, warnings = self.document.verdict, tuple(self.document.warnings)
        count = len(verdict.reasons) - len(warnings)
        return Assessment(verdict.level, verdict.sentence, tuple(verdict.reasons[:count]), warnings)

    @cached_property
    def chain(self) -> Mechanism:
        """The nominal joints that were calibrated: a chain, or a tree of them."""
        robot = self.document.robot
        joints = tuple(
            Joint(
                name=name,
                type=joint.type,
                axis=frozen(joint.axis),
                lower=-np.inf if joint.lower is None else joint.lower,
                upper=np.inf if joint.upper is None else joint.upper,
                mimic=None if joint.mimic is None else Mimic(**joint.mimic.model_dump()),
            )
            for name, joint in robot.joints.items()
        )
        index = {None: BASE} | {name: i for i, name in enumerate(robot.joints)}
        parents = tuple(index[joint.parent] for joint in robot.joints.values())
        tips = tuple(Tip(link, index[tip.joint], frozen(tip.T_joint_link)) for link, tip in robot.tips.items())
        nominal = frozen([joint.nominal for joint in robot.joints.values()])
        kind = Chain if len(tips) == 1 else Tree
        return kind(robot.name, robot.base_link, joints, parents, nominal, tips)

    @cached_property
    def placements(self) -> Floats:
        """(n, 4, 4) calibrated placement of each joint in the frame of its parent joint. [m]."""
        return frozen([joint.calibrated for joint in self.document.robot.joints.values()])

    @cached_property
    def dh_offsets(self) -> Floats | None:
        """(rows, 5) added to the DH rows, columns as ``dh.PARAMETERS`` [rad, m]; None for whole placements."""
        entries = [entry for entry in self.document.dh if entry.parameter in PARAMETERS]
        if not entries:
            return None
        labels = rows_of(self.chain).labels
        offsets = np.zeros((len(labels), len(PARAMETERS)))
        for entry in entries:
            offsets[labels.index(entry.joint), PARAMETERS.index(entry.parameter)] = entry.offset
        return frozen(offsets)

    @property
    def failures(self) -> tuple[str, ...]:
        """Why this result should not be used; empty when it passed its checks."""
        return self.assessment.failures

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to check before trusting the result."""
        return self.assessment.warnings

    def __repr__(self) -> str:
        validation, verdict = self.document.validation, self.document.verdict
        return (
            f"<{type(self).__name__} of {self.chain.name}: {len(self.chain.names)} joints, held-out poses "
            f"{validation.rms_nominal_mm:.3g} -> {validation.rms_mm:.3g} mm rms, {verdict.level}: {verdict.sentence}>"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data: the contract of ``calibration.json``."""
        return self.document.to_dict()

    @staticmethod
    def load(path: str | Path) -> Calibration:
        """Read a saved calibration, of format ``urdfcal/2`` or ``urdfcal/1``.

        Args:
            path: calibration.json, or the folder of results that holds it.

        Raises:
            OutputError: it cannot be read, is of another format, or was edited into something that is no result.
        """
        from urdfcal.result.document import read_document

        path = Path(path)
        file = path / FILE_NAME if path.is_dir() else path
        remedy = "Name a folder that `urdfcal calibrate` wrote."
        if file.suffix in (".urdf", ".xacro"):
            raise OutputError("this is a robot's description, and no result", where=str(file), remedy=remedy)
        files.settle(file.parent)
        try:
            text = file.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "it is not text"
            raise OutputError(f"cannot be read: {reason}", where=str(file), remedy=remedy) from error
        return Calibration(read_document(text, str(file)))

    def save(self, path: str | Path) -> None:
        """Write the result as JSON, format ``urdfcal/2``; numbers read back exactly."""
        files.write_text(Path(path), self.document.to_json())

    @cached_property
    def sha256(self) -> str:
        """Hash of what ``save`` writes, in hexadecimal: tells which calibration something was made from."""
        return hashlib.sha256(self.document.to_json().encode()).hexdigest()

    @cached_property
    def calibrated(self) -> Mechanism:
        """The joints with their calibrated placements."""
        return self.chain.with_placements(self.placements)

    @cached_property
    def mechanism(self) -> Mechanism:
        """The calibrated joints, and before each link that bends two flexures: what :meth:`joint_values` are for.

        ``mechanism.build_model()`` is its Pinocchio model. Where no link bends it is :attr:`calibrated`.
        """
        mechanism = self.joint_models.mechanism
        return mechanism.with_placements(spread_placements(mechanism, self.placements))

    def apply(self, model: pin.Model, *, in_place: bool = False) -> pin.Model:
        """Give a Pinocchio model of this robot the calibrated joint placements.

        Args:
            model: any model of the nominal robot, joints found by name: with a gripper, on a free-flyer, in another
                order, or reduced, locked joints included. Its inertias and collision geometry stay nominal.
            in_place: change this model instead of a copy. A data structure made of it stays valid.

        Returns:
            The calibrated model: the rigid arm. Joint models, such as compliance, are none of it: give it the joint
            values of :meth:`joint_values`, which where links bend are those of ``mechanism.build_model()`` instead.

        Raises:
            RobotError: a joint is missing, or its placement is not the nominal one that was calibrated; the model is
                as it was.
        """
        calibrated = model if in_place else model.copy()
        apply_to_model(calibrated, self.chain, self.placements)
        return calibrated

    def apply_to_urdf(self, urdf: Urdf) -> bytes:
        """Write the calibrated origins into a URDF of this robot: the one calibrated, or one made anew.

        Returns:
            The corrected file; nothing but values of ``<origin>`` has changed.

        Raises:
            RobotError: a joint is missing, or its origin is not the nominal one that was calibrated.
        """
        return apply_to_urdf(urdf, self.chain, self.placements)

    def in_domain(self, q: ArrayLike) -> Bools:
        """Tell which configurations lie in the measured domain: every joint within the values that were measured.

        Outside, the accuracy that the result claims is an extrapolation. Inside it may be, too: ranges do not say which
        values were measured together.

        Args:
            q: (..., k) values of the actuated joints, in the order of ``chain.actuated``. [rad or m]

        Returns:
            (...).

        Raises:
            OutputError: the result's file is of a version that did not store the domain.
        """
        if self.document.domain is None:
            raise OutputError("the result does not hold the measured domain", remedy="Calibrate its session again.")
        result: Bools = np.all(beyond(self.chain, q, self.document.domain.joints) == 0.0, axis=-1)
        return result

    @cached_property
    def joint_models(self) -> FoundJointModels:
        """What stands between the joints' readings and their true values; nothing of a rigid arm."""
        from urdfcal.result.joint_model_sections import found_joint_models

        return found_joint_models(self.document, self.chain)

    def joint_values(
        self,
        readings: ArrayLike,
        torques: ArrayLike | None = None,
        previous: ArrayLike | None = None,
        payload: Carried = None,
    ) -> Floats:
        """Compute the joints' true values, for any program that has the calibrated placements (:meth:`apply`).

        Where links bend, no values of the joints alone are true: those of :attr:`mechanism` are returned.

        Args:
            readings: (..., k) of the actuated joints, in the order of ``chain.actuated``. [rad or m]
            torques: (..., k) measured joint torques; needed where compliances were found with such. [N m or N]
            previous: (..., k) readings where the arm came from; without them it neither lags nor has play. [rad or m]
            payload: what the arm carries, or ``"nothing"``; None for what it carried when it was calibrated, of several
                sessions in the first. Measured torques hold it already.

        Returns:
            (..., n) of all joints, mimic joints and flexures included. [rad or m]

        Raises:
            RobotError: shapes do not agree, a reading is not finite or far outside its joint's limits, or nothing is
                known of the payload's link.
            SessionError: the torques are missing.
        """
        return self.joint_values_with_jacobian(readings, torques, previous, payload)[0]

    def joint_values_with_jacobian(
        self,
        readings: ArrayLike,
        torques: ArrayLike | None = None,
        previous: ArrayLike | None = None,
        payload: Carried = None,
    ) -> tuple[Floats, Floats]:
        """Compute :meth:`joint_values` (..., n), and their derivative (..., n, k) by the readings."""
        q, shape, given = self._given(readings, torques=torques, previous=previous)
        self._check_readings("readings", q)
        values, J = self._carrying(payload).joint_values(q, **given)
        return values.reshape(*shape, -1), J.reshape(*shape, *J.shape[1:])

    def forward(
        self,
        readings: ArrayLike,
        torques: ArrayLike | None = None,
        previous: ArrayLike | None = None,
        payload: Carried = None,
    ) -> Floats:
        """Compute the calibrated tip's frame T_base_tip (..., 4, 4) with all joint models; see :meth:`joint_values`."""
        values = self.joint_values(readings, torques, previous, payload)
        T = tip_poses(self.mechanism, values.reshape(-1, values.shape[-1]))
        return T.reshape(*values.shape[:-1], 4, 4)

    def compensate(
        self,
        q: ArrayLike,
        torques: ArrayLike | None = None,
        previous: ArrayLike | None = None,
        payload: Carried = None,
    ) -> Compensation:
        """Find joint commands for a controller that keeps its nominal kinematics.

        With them the real tip, the first one of joints that branch, goes where the nominal robot's would go with ``q``.
        Joints that do not carry it keep their values.

        Args:
            q: (..., k) nominal values of the actuated joints, in the order of ``chain.actuated``. [rad or m]
            torques: (..., k), see :meth:`joint_values`.
            previous: (..., k) where the arm comes from.
            payload: what it carries, see :meth:`joint_values`.

        Raises:
            RobotError: a value is not finite, or beyond its joint's limits.
            SessionError: the torques are missing.
        """
        bends = self._carrying(payload)
        commands, shape, given = self._given(q, torques=torques, previous=previous)
        if not shape:
            here = {name: values[0] for name, values in given.items()}
            true = bends.of_one(**here) if bends.found else self._arms[1].told
            one = compensate_one(*self._arms, commands[0], true)
            if one is not None:
                return one
        if not bends.found:
            return compensate(self.chain, self.calibrated, q)

        def true_values(commands: Floats, some: Ints) -> tuple[Floats, Floats]:
            return bends.joint_values(commands, **{name: values[some] for name, values in given.items()})

        return compensate(self.chain, self.mechanism, q, true_values)

    @cached_property
    def _arms(self) -> tuple[TipAtOnce, TipAtOnce]:
        """The nominal arm and the calibrated one."""
        return TipAtOnce(self.chain), TipAtOnce(self.mechanism)

    def _carrying(self, payload: Carried) -> FoundJointModels:
        return self.joint_models if payload is None else self.joint_models.carrying(payload)

    def _given(self, readings: ArrayLike, **others: ArrayLike | None) -> tuple[Floats, tuple[int, ...], dict[str, Any]]:
        """Readings as (N, k), the shape (...) that they came in, and what was given beside, alike."""
        q, k = np.asarray(readings, dtype=float), len(self.chain.actuated)
        given = {name: np.asarray(values, dtype=float) for name, values in others.items() if values is not None}
        for name, values in {"readings": q, **given}.items():
            if values.shape != q.shape or q.shape[-1:] != (k,):
                raise RobotError(
                    f"{name} of shape {values.shape} are not one of each of {k} joints for each pose",
                    where=self.chain.name,
                    remedy=f"Give them in this order: {', '.join(self.chain.actuated)}.",
                )
        if "previous" in given:
            self._check_readings("previous", given["previous"])
        return q.reshape(-1, k), q.shape[:-1], {name: values.reshape(-1, k) for name, values in given.items()}

    @cached_property
    def _readable(self) -> tuple[Floats, Floats]:
        """The least and the largest reading (k,) that are one: of limits, and of what was measured. [rad or m]."""
        lower, upper = (np.array(limit) for limit in self.chain.limits)
        domain = {} if self.document.domain is None else self.document.domain.joints
        for k, name in enumerate(self.chain.actuated):
            low, high = domain.get(name, (np.inf, -np.inf))
            lower[k], upper[k] = min(lower[k], low) - _FAR_OUTSIDE, max(upper[k], high) + _FAR_OUTSIDE
        return lower, upper

    def _check_readings(self, name: str, readings: Floats) -> None:
        """Refuse readings (..., k) that are in other units, or none."""
        lower, upper = self._readable
        wrong = ~((readings >= lower) & (readings <= upper) & np.isfinite(readings)).reshape(-1, len(lower))
        if wrong.any():
            pose, k = np.argwhere(wrong)[0].tolist()
            joint, value = self.chain.actuated_joints[k], float(readings.reshape(-1, len(lower))[pose, k])
            raise RobotError(
                f"{joint.name} = {value:g} {joint.unit} is outside of [{lower[k]:.4g}, {upper[k]:.4g}], the joint's "
                "limits and what was measured",
                where=f"{name}, pose {pose}",
                remedy="Readings are in radians and metres, of the robot that was calibrated.",
            )


def corrected_name(urdf_reference: str) -> str:
    """Return the file name of the corrected URDF: the nominal one's with ``_calibrated``."""
    nominal = PurePosixPath(urdf_reference)
    return f"{nominal.stem}_calibrated{nominal.suffix}"
