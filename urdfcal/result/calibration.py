"""A calibrated robot, as a motion stack uses it: loaded, applied, compensated for, saved."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal import files
from urdfcal.arrays import Bools, Floats, frozen
from urdfcal.errors import OutputError
from urdfcal.robot.apply import apply_to_model, apply_to_urdf
from urdfcal.robot.chain import Chain, Tree
from urdfcal.robot.compensation import Compensation, compensate
from urdfcal.robot.dh import PARAMETERS
from urdfcal.robot.mechanism import BASE, Joint, Mechanism, Tip
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.urdf import Mimic
from urdfcal.session.domain import beyond

if TYPE_CHECKING:
    import pinocchio as pin
    from numpy.typing import ArrayLike

    from urdfcal.estimation.assessment import Assessment
    from urdfcal.result.document import ResultDocument, RobotSection
    from urdfcal.robot.urdf.urdf import Urdf

FILE_NAME = "calibration.json"


class Calibration(ABC):
    """A calibrated robot: its nominal joints, their calibrated placements, and the result document.

    Immutable, so that threads may share it.

    Attributes:
        assessment: whether to trust it, and what speaks against it.
    """

    assessment: Assessment

    @property
    @abstractmethod
    def chain(self) -> Mechanism:
        """The nominal joints that were calibrated: a chain, or a tree of them."""

    @property
    @abstractmethod
    def placements(self) -> Floats:
        """(n, 4, 4) calibrated placement of each joint in the frame of its parent joint. [m]."""

    @property
    @abstractmethod
    def dh_offsets(self) -> Floats | None:
        """(rows, 5) added to the DH rows, columns as ``dh.PARAMETERS`` [rad, m]; None for whole placements."""

    @property
    @abstractmethod
    def document(self) -> ResultDocument:
        """Everything the calibration says: what ``calibration.json`` holds."""

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
        try:
            text = file.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "it is not text"
            raise OutputError(
                f"cannot be read: {reason}", where=str(file), remedy="Name a folder that `urdfcal calibrate` wrote."
            ) from error
        document = read_document(text, str(file))
        return _Loaded(document, document.assessment)

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

    def apply(self, model: pin.Model, *, in_place: bool = False) -> pin.Model:
        """Give a Pinocchio model of this robot the calibrated joint placements.

        Args:
            model: any model of the nominal robot, joints found by name: with a gripper, on a free-flyer, in another
                order, or reduced, locked joints included. Its inertias and collision geometry stay nominal.
            in_place: change this model instead of a copy. A data structure made of it stays valid.

        Returns:
            The calibrated model.

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

    def compensate(self, q: ArrayLike) -> Compensation:
        """Find joint commands for a controller that keeps its nominal kinematics.

        With them the real tip, the first one of joints that branch, goes where the nominal robot's would go with ``q``.
        Joints that do not carry it keep their values.

        Args:
            q: (..., k) nominal values of the actuated joints, in the order of ``chain.actuated``. [rad or m]

        Raises:
            RobotError: a value is not finite, or beyond its joint's limits.
        """
        return compensate(self.chain, self.calibrated, q)


@dataclass(frozen=True, eq=False, repr=False)
class _Loaded(Calibration):
    """A calibration that was read from its file."""

    read: ResultDocument
    assessment: Assessment

    @property
    def document(self) -> ResultDocument:
        return self.read

    @cached_property
    def chain(self) -> Mechanism:
        return _mechanism(self.read.robot)

    @cached_property
    def placements(self) -> Floats:
        return frozen([joint.calibrated for joint in self.read.robot.joints.values()])

    @cached_property
    def dh_offsets(self) -> Floats | None:
        entries = [entry for entry in self.read.dh if entry.parameter in PARAMETERS]
        if not entries:
            return None
        labels = rows_of(self.chain).labels
        offsets = np.zeros((len(labels), len(PARAMETERS)))
        for entry in entries:
            offsets[labels.index(entry.joint), PARAMETERS.index(entry.parameter)] = entry.offset
        return frozen(offsets)


def corrected_name(urdf_reference: str) -> str:
    """Return the file name of the corrected URDF: the nominal one's with ``_calibrated``."""
    nominal = PurePosixPath(urdf_reference)
    return f"{nominal.stem}_calibrated{nominal.suffix}"


def _mechanism(robot: RobotSection) -> Mechanism:
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
