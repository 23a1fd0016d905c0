"""The arms of two calibrations at rest, under one load, and the first with what the joints of the second do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from urdfcal.result.joint_model_sections import found_joint_models
from urdfcal.robot.flexure import spread_placements
from urdfcal.robot.kinematics import link_poses

if TYPE_CHECKING:
    from collections.abc import Container, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.found import FoundJointModels
    from urdfcal.result.calibration import Calibration
    from urdfcal.result.document import ResultDocument
    from urdfcal.robot.mechanism import Mechanism, Tip


@dataclass(frozen=True, eq=False)
class ComparedArm:
    """A calibrated arm at rest.

    Attributes:
        placements: (n, 4, 4) of the joints, calibrated. [m]
        bends: its joint models.
    """

    placements: Floats
    bends: FoundJointModels

    def frames(self, readings: Floats, tips: Sequence[Tip]) -> tuple[Floats, ...]:
        """Compute the frames T_base_tip (N, 4, 4) [m] of some tip links at readings (N, k) [rad or m]."""
        mechanism = self.bends.mechanism
        values, _ = self.bends.joint_values(readings)
        own = [mechanism.tip(tip.link) for tip in tips]
        return link_poses(mechanism, values, own, spread_placements(mechanism, self.placements))


@dataclass(frozen=True, eq=False)
class ComparedArms:
    """The arms of two calibrations of one robot.

    Attributes:
        chain: the nominal joints.
        first: the document of the first one, with the load that both are compared under.
        second: the document of the second one, with it.
        placements: (n, 4, 4) of the joints, of each. [m]
        rigid: whether they are compared without joint models: one gives way to measured torques, which nobody knows at
            other readings.
        unloaded: whether they carried different things, so that they are compared without.
    """

    chain: Mechanism
    first: ResultDocument
    second: ResultDocument
    placements: tuple[Floats, Floats]
    rigid: bool
    unloaded: bool

    @classmethod
    def of(cls, a: Calibration, b: Calibration) -> ComparedArms:
        """Take two calibrations of the same nominal joints; gravity is the first one's."""
        documents, placements = [a.document, b.document], (a.placements, b.placements)
        if a.joint_models.needs_torques or b.joint_models.needs_torques:
            rigid = [document.model_copy(update={"joint_models": {}, "load": None}) for document in documents]
            return cls(a.chain, rigid[0], rigid[1], placements, rigid=True, unloaded=False)
        loads = [document.load for document in documents if document.load is not None]
        carried = [load.payload for load in loads if load.masses]
        unloaded = any(payload != carried[0] for payload in carried)
        changed: dict[str, object] = {"payload": None} if unloaded else {}
        if loads:
            changed["gravity"] = loads[0].gravity
        first, second = (
            of if of.load is None else of.model_copy(update={"load": of.load.model_copy(update=changed)})
            for of in documents
        )
        return cls(a.chain, first, second, placements, rigid=False, unloaded=unloaded)

    def both(self) -> tuple[ComparedArm, ComparedArm]:
        """Return the two arms."""
        one, other = (found_joint_models(document, self.chain) for document in (self.first, self.second))
        return ComparedArm(self.placements[0], one), ComparedArm(self.placements[1], other)

    def with_joint(self, joint: str, placements: Floats, models: Container[str]) -> ComparedArm:
        """Return the first arm with other placements, and with the second's joint models of a joint, of some names."""
        document = self.first
        mine, theirs = (of.joint_models.get(joint, {}) for of in (document, self.second))
        kept = {name: of for name, of in mine.items() if name not in models}
        taken = {name: of for name, of in theirs.items() if name in models}
        if taken or kept != mine:
            others = {name: of for name, of in document.joint_models.items() if name != joint}
            mixed = {**others, joint: {**kept, **taken}} if kept or taken else others
            own, second = document.load, self.second.load
            heavy = own if own is not None and own.masses else second or own
            document = document.model_copy(update={"joint_models": mixed, "load": heavy if mixed else None})
        return ComparedArm(placements, found_joint_models(document, self.chain))
