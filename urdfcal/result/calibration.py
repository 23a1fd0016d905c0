"""A calibrated robot, as a motion stack uses it: loaded, applied, compensated for, saved."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal import files
from urdfcal.arrays import Floats, frozen
from urdfcal.errors import OutputError
from urdfcal.robot.apply import apply_to_model, apply_to_urdf
from urdfcal.robot.chain import Chain, Tree
from urdfcal.robot.compensation import Compensation, compensate
from urdfcal.robot.dh import PARAMETERS
from urdfcal.robot.mechanism import BASE, Joint, Mechanism, Tip
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.urdf import Mimic

if TYPE_CHECKING:
    import pinocchio as pin
    from numpy.typing import ArrayLike

    from urdfcal.robot.urdf.urdf import Urdf

FORMAT = "urdfcal/1"
FILE_NAME = "calibration.json"


class Calibration(ABC):
    """The robot that was really built, as far as a session told. Immutable, so that threads may share it."""

    @property
    @abstractmethod
    def chain(self) -> Mechanism:
        """The joints that were calibrated, as drawn: a chain, or a tree of them."""

    @property
    @abstractmethod
    def placements(self) -> Floats:
        """(n, 4, 4) calibrated placement of each joint in the frame of the one it hangs on. [m]."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """The result as plain data: the contract of ``calibration.json`` (DESIGN section 7)."""

    @staticmethod
    def load(path: str | Path) -> Calibration:
        """Read a saved calibration.

        Args:
            path: calibration.json, or the folder of results that holds it.

        Raises:
            OutputError: it cannot be read, is of another format, or was edited into something that is no result.
        """
        from urdfcal.result.document import check

        path = Path(path)
        file = path / FILE_NAME if path.is_dir() else path
        try:
            text = file.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "it is not text"
            raise OutputError(
                f"cannot be read: {reason}", where=str(file), remedy="Name a folder that `urdfcal calibrate` wrote."
            ) from error
        document = check(text, str(file), FORMAT)
        return _Loaded(_mechanism_from(document["robot"]), _matrices(document["robot"], "built"), text)

    def save(self, path: str | Path) -> None:
        """Write the result as JSON, format ``urdfcal/1``; numbers read back exactly."""
        files.write_text(Path(path), self.to_json())

    def to_json(self) -> str:
        """What ``save`` writes."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"

    @cached_property
    def sha256(self) -> str:
        """Hash of what ``save`` writes, in hexadecimal: tells which calibration something was made from."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()

    @cached_property
    def calibrated(self) -> Mechanism:
        """The joints with their calibrated placements."""
        return self.chain.with_placements(self.placements)

    @cached_property
    def dh_offsets(self) -> Floats | None:
        """(rows, 5) added to the DH rows, columns as ``dh.PARAMETERS`` [rad, m]; None where whole placements were."""
        entries = [entry for entry in self.to_dict()["dh"] if entry["parameter"] in PARAMETERS]
        if not entries:
            return None
        labels = rows_of(self.chain).labels
        offsets = np.zeros((len(labels), len(PARAMETERS)))
        for entry in entries:
            offsets[labels.index(entry["joint"]), PARAMETERS.index(entry["parameter"])] = entry["offset"]
        return frozen(offsets)

    def apply(self, model: pin.Model, *, in_place: bool = False) -> pin.Model:
        """Give a Pinocchio model of this robot the calibrated joint placements.

        Args:
            model: any model of the robot as drawn, joints found by name: with a gripper, on a free-flyer, in another
                order, or reduced, locked joints included. Its inertias and collision geometry stay as drawn.
            in_place: change this model instead of a copy. A data structure made of it stays valid.

        Returns:
            The calibrated model.

        Raises:
            RobotError: a joint is missing, or its placement is not the drawn one that was calibrated; the model is
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
            RobotError: a joint is missing, or its origin is not the drawn one that was calibrated.
        """
        return apply_to_urdf(urdf, self.chain, self.placements)

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


@dataclass(frozen=True, eq=False)
class _Loaded(Calibration):
    """A calibration as its file tells it; the text was checked when it was read."""

    drawn: Mechanism
    built: Floats
    text: str

    @property
    def chain(self) -> Mechanism:
        return self.drawn

    @property
    def placements(self) -> Floats:
        return self.built

    def to_dict(self) -> dict[str, Any]:
        document: dict[str, Any] = json.loads(self.text)
        return document


def corrected_name(urdf_reference: str) -> str:
    """File name of the corrected URDF: the drawn one's with ``_calibrated``."""
    drawn = PurePosixPath(urdf_reference)
    return f"{drawn.stem}_calibrated{drawn.suffix}"


def describe(chain: Mechanism, placements: Floats, urdf_reference: str) -> dict[str, Any]:
    """The ``robot`` part of calibration.json: the joints as drawn, and how they were built."""
    return {
        "name": chain.name,
        "urdf": urdf_reference,
        "base_link": chain.base_link,
        "tip_link": chain.tip_link,
        "joints": {
            joint.name: {
                "parent": None if parent == BASE else chain.names[parent],
                "type": joint.type,
                "axis": joint.axis.tolist(),
                "lower": joint.lower if np.isfinite(joint.lower) else None,
                "upper": joint.upper if np.isfinite(joint.upper) else None,
                "mimic": None
                if joint.mimic is None
                else {
                    "joint": joint.mimic.joint,
                    "multiplier": joint.mimic.multiplier,
                    "offset": joint.mimic.offset,
                },
                "drawn": drawn.tolist(),
                "built": built.tolist(),
            }
            for joint, parent, drawn, built in zip(
                chain.joints, chain.parents, chain.placements, placements, strict=True
            )
        },
        "tips": {
            tip.link: {
                "joint": None if tip.joint == BASE else chain.names[tip.joint],
                "T_joint_link": tip.T_joint_link.tolist(),
            }
            for tip in chain.tips
        },
    }


def _mechanism_from(robot: dict[str, Any]) -> Mechanism:
    joints = tuple(
        Joint(
            name=name,
            type=joint["type"],
            axis=frozen(joint["axis"]),
            lower=-np.inf if joint["lower"] is None else joint["lower"],
            upper=np.inf if joint["upper"] is None else joint["upper"],
            mimic=None if joint["mimic"] is None else Mimic(**joint["mimic"]),
        )
        for name, joint in robot["joints"].items()
    )
    index = {None: BASE} | {name: i for i, name in enumerate(robot["joints"])}
    parents = tuple(index[joint["parent"]] for joint in robot["joints"].values())
    tips = tuple(Tip(link, index[tip["joint"]], tip["T_joint_link"]) for link, tip in robot["tips"].items())
    name, base_link, drawn = robot["name"], robot["base_link"], _matrices(robot, "drawn")
    if len(tips) == 1:
        return Chain(name, base_link, tips[0].link, joints, drawn, tips[0].T_joint_link)
    return Tree(name, base_link, joints, parents, drawn, tips)


def _matrices(robot: dict[str, Any], which: str) -> Floats:
    return frozen([joint[which] for joint in robot["joints"].values()])
