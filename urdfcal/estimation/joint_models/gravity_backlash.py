"""Gravity's backlash: the load on a joint presses its gear against one flank or the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.joint_models.backlash import Backlash
from urdfcal.estimation.joint_models.under_torque import UnderTorque

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.estimation.joint_models.linear import Prior
    from urdfcal.robot.mechanism import Joint

# Less does not press a gear against a flank: the friction of the smallest servos holds more. [N m or N]
_SLACK = 0.01


@dataclass(frozen=True, eq=False)
class GravityBacklash(UnderTorque):
    """A joint rests on the flank that its load presses it to, half of its backlash from the middle.

    So do gears that gravity turns back: servos and belts of cheap arms. Those that friction holds stay on the side
    that they came from (``backlash``). Both have the same size, and the same prior.
    """

    name: ClassVar[str] = "gravity_backlash"
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"side of the load": (0,)}
    over: ClassVar[tuple[str, str, str] | None] = ("side that its load presses it to", "1", "1")
    revolute: ClassVar[Prior | None] = Backlash.revolute
    prismatic: ClassVar[Prior | None] = Backlash.prismatic

    def features(self, readings: Readings) -> Floats:
        """Return the direction that the load presses to."""
        carried = self.carried(readings)
        return np.sign(np.where(np.abs(carried) > _SLACK, carried, 0.0))

    def slopes(self, readings: Readings) -> Floats:
        """Return zeros: a direction does not depend on how much."""
        del readings
        return np.zeros(self.selection.shape)

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say how far the two sides are apart."""
        unit = "mm" if joint.prismatic else "mrad"
        return f"{joint.name} is {2e3 * abs(p[0]):.2g} {unit} apart between loads on its two sides: backlash"

    def sentence_of_all(self, joints: str, most: float) -> str:
        """Say how far from the middle they rest."""
        return f"backlash of {joints} between loads on its two sides, by up to {most:.2g} mrad"
