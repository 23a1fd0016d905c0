"""Gain: a joint moves by more or less than it reads, by a wrong gear ratio or a lead screw's pitch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from urdfcal.estimation.joint_models.linear import LinearJointModel, Prior

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.robot.mechanism import Joint


@dataclass(frozen=True, eq=False)
class Gain(LinearJointModel):
    """A joint's error is a share of its reading.

    Ball screws of ISO 3408 class 7 err by 52 um over 300 mm, of class 10 by 210 um: 2e-4 to 7e-4. Gear ratios are
    exact; one that is entered wrongly, or an encoder's scale, is off by any share.
    """

    name: ClassVar[str] = "gain"
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"gain": (0,)}
    revolute: ClassVar[Prior | None] = Prior("1", 2e-4)
    prismatic: ClassVar[Prior | None] = Prior("1", 2e-4)
    certain: ClassVar[float] = 6.0  # of an SO-101's joint off by 0.1 % regions bear out 12 of 30, and 16 with it

    def features(self, readings: Readings) -> Floats:
        """Return the readings."""
        return self.read(readings.q)

    def slopes(self, readings: Readings) -> Floats:
        """Return one for the joint itself."""
        return self.selection

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say by what share."""
        return f"{joint.name} moves {1e2 * p[0]:+.2g} % more than it reads: gear ratio, or screw pitch"

    def sentence_of_all(self, joints: str, most: float) -> str:
        """Say how much."""
        return f"wrong gain of {joints}, by up to {most:.2g} mrad: gear ratio, or screw pitch"
