"""Zero offsets: each joint's encoder is mounted a constant angle or distance off."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.blocks.arm import no_offsets, parameter_tolerance, zero_rows
from urdfcal.estimation.joint_models.base import JointModel
from urdfcal.estimation.state import Key
from urdfcal.robot.flexure import rigid_joints

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Self

    from urdfcal.arrays import Floats
    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.session.model import Positions

ZERO_OFFSETS: Key[Floats] = Key("zero_offset")
"""(n,) added to each joint's reading. [rad or m]"""


@dataclass(frozen=True, eq=False)
class ZeroOffsets(JointModel):
    """A constant added to each joint reading, for an arm whose geometry is nominal.

    With DH rows estimated it is theta's offset (d's of a prismatic joint), and the model is left out.

    Attributes:
        carry: (n, k) derivative of all joints' values by those of the joints that have an offset: all but flexures.
    """

    carry: Floats = field(kw_only=True)

    name: ClassVar[str] = "zero_offset"
    toleranced: ClassVar[bool] = True
    order: ClassVar[int] = 0
    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, session: Positions) -> Self:
        """Take one offset of each joint, with the tolerance of zero offsets as its prior."""
        real, tolerances = rigid_joints(session.chain), session.tolerances
        joints = [session.chain.joints[i] for i in real]
        words = ["d" if joint.prismatic else "theta" for joint in joints]
        sigma = np.array(
            [parameter_tolerance(tolerances, j.name, word, zero=True) for j, word in zip(joints, words, strict=True)]
        )
        return cls(
            key=ZERO_OFFSETS,
            names=tuple(f"{joint.name}.{word}" for joint, word in zip(joints, words, strict=True)),
            units=tuple("m" if joint.prismatic else "rad" for joint in joints),
            nominal=np.zeros(len(joints)),
            sigma=np.where(sigma > 0.0, sigma, np.inf),
            fixed={int(k): "fixed by the session's tolerances" for k in np.flatnonzero(sigma == 0.0)},
            phrase="the joints' zero offsets",
            carry=np.eye(len(session.chain.joints))[:, real],
        )

    @classmethod
    def enabled(cls, session: Positions, geometry: str) -> bool:
        """Return whether nothing but zero offsets is estimated of the arm."""
        del session
        return geometry == "offsets"

    @classmethod
    def estimated(cls, session: Positions, geometry: str) -> bool:
        """Return whether zero offsets have parameters of their own: switched on beside DH rows they are theta's."""
        return cls.enabled(session, geometry) and bool(session.joint_models.get(cls.name, True))

    def values(self, readings: Readings, p: Floats) -> Floats:
        """Return the offsets, the same at every pose."""
        return np.broadcast_to(self.carry @ p, readings.q.shape)

    def jacobian(self, readings: Readings, p: Floats) -> Floats:
        """Return the identity, for joints that have an offset."""
        del p
        return np.broadcast_to(self.carry, (len(readings.q), *self.carry.shape))

    def offsets(self, arm: ArmParameterization, p: Floats) -> Floats:
        """Return the same as offsets of the rows' joint variables."""
        offsets = no_offsets(arm)
        for joint, (row, column) in zero_rows(arm).items():
            offsets[row, column] = p[arm.chain.names.index(joint)]
        return offsets

    def unidentifiable(self, index: int, partners: Sequence[int]) -> str | None:
        """Offsets of joints on parallel axes only appear as a sum."""
        if not partners:
            return f"{self.label(index)} moves nothing that is measured (an LED on the last axis hides it)"
        others = " and ".join(self.label(k) for k in partners)
        return f"{self.label(index)} and {others} only appear as a sum (their axes are parallel)"
