"""Bending of links: each leans aside under the weight that it carries, by its own walls and the joint's bearing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.estimation.joint_models.linear import Prior
from urdfcal.estimation.joint_models.under_torque import UnderTorque, Yielding
from urdfcal.robot.flexure import ACROSS, flexures_of
from urdfcal.session.bending import BENDING, bent

if TYPE_CHECKING:
    from collections.abc import Mapping

    from typing_extensions import Self

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.estimation.joint_models.linear import OneCommand
    from urdfcal.robot.mechanism import Joint
    from urdfcal.session.model import Positions


@dataclass(frozen=True, eq=False)
class Bending(UnderTorque):
    """The link before a joint turns about two axes across the joint's, by a compliance times the moment about each.

    The axes are the joint's x and y where it turns about z, fixed in the link that bends. What a link does over its
    length counts as if it did it at its end; a compliance about the joint's own axis is the joint's. It needs the
    masses of the links and gravity's direction: moments across a joint are not measured.

    A gear head's crossed roller bearing has a moment stiffness of the order of 1e5 N m/rad, thus 1e-5 rad/(N m)
    (Harmonic Drive, CSF and CSG catalogue, Specifications for Cross Roller Bearing); an aluminium tube of 100 mm, 4 mm
    thick and 0.6 m long has L / (E I) = 6e-6.
    """

    name: ClassVar[str] = BENDING
    words: ClassVar[tuple[str, ...]] = ACROSS
    needs: ClassVar[str] = "masses in the URDF and gravity's direction, and no measured torques"
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"moment across it": (0, 1)}
    revolute: ClassVar[Prior | None] = Prior("rad/(N m)", 1e-5, 0.05)
    prismatic: ClassVar[Prior | None] = revolute  # the link before it turns, too

    @classmethod
    def of(cls, session: Positions) -> Self | None:
        """Take every joint before which the session has links bend."""
        return super().of(bent(session))

    @classmethod
    def concerns(cls, session: Positions, joint: Joint) -> bool:
        """Return whether the link before a joint may bend."""
        return bool(flexures_of(session.chain, joint.name))

    @classmethod
    def depends_on(cls, session: Positions) -> dict[str, Any] | None:
        """Take the masses of URDF and payload under gravity, where its direction is known and no torque measured."""
        return None if session.torques is not None else super().depends_on(session)

    def features(self, readings: Readings) -> Floats:
        """Return the moments, against which a link gives way."""
        found: Floats = -self.torques(readings, self.gravity)[:, self._at]
        return found

    def slopes(self, readings: Readings) -> Floats:
        """Return those of the moments."""
        found = np.zeros((len(readings.q), len(self), readings.q.shape[1]))
        for part, here in self.parts(readings):
            found[here] = -self.masses[part].slopes(readings.q[here], self.gravity)[:, self._at]
        return found

    def of_one(self, p: Floats) -> OneCommand:
        """Take the moments straight from Pinocchio."""
        if len(self.masses) != 1:
            return super().of_one(p)
        return Yielding(self.masses[0], self.gravity, -(self._carry * p) @ self._carry.T)

    @cached_property
    def _at(self) -> Ints:
        """(k,) index of the flexure that each parameter is of."""
        each = (flexures_of(self.mechanism, joint) for joint in dict.fromkeys(self.names_of_joints))
        return np.array([index for pair in each for index in pair], dtype=np.intp)

    @cached_property
    def _carry(self) -> Floats:
        """(n, k) derivative of all joints' values by the flexures that the parameters are of."""
        return np.eye(len(self.mechanism.joints))[:, self._at]

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say how much it bends."""
        del group
        size = np.linalg.norm(p)
        return f"the link before {joint.name} bends aside under the arm's weight, {size:.1e} rad/(N m)"

    def sentence_of_all(self, joints: str, most: float) -> str:
        """Say how much they bend."""
        return f"bending of the links before {joints} under the arm's weight, by up to {most:.2g} mrad"
