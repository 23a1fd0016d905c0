"""Backlash: a joint rests on one flank of its gear or on the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.joint_models.linear import LinearJointModel, Prior

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.robot.mechanism import Joint

# A joint that moved by less since the pose before did not move. [rad or m]
_STILL = 1e-6


@dataclass(frozen=True, eq=False)
class Backlash(LinearJointModel):
    """A joint stops short by half of its backlash, on the side that it came from.

    Gears of industrial arms have less than one minute of arc (Nabtesco RV, Harmonic Drive: 0.3 mrad), servos of cheap
    arms several milliradians.
    """

    name: ClassVar[str] = "backlash"
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"approach": (0,)}
    over: ClassVar[tuple[str, str, str] | None] = ("side that it came from", "1", "1")
    revolute: ClassVar[Prior | None] = Prior("rad", 1e-4)
    prismatic: ClassVar[Prior | None] = Prior("m", 1e-5)
    # The side a joint came from tells nothing of regions. A measured rigid arm gains up to 5.6, none of 102 simulated
    # ones 6; with 10 the tip of so101 with backlash is 1.27 x the bound off, with 6 1.18 x.
    certain: ClassVar[float] = 6.0
    at_rest: ClassVar[bool] = True

    def features(self, readings: Readings) -> Floats:
        """Return the direction that the joint came in."""
        if readings.previous is None:
            return np.zeros((len(readings.q), len(self)))
        came = self.read(readings.q - readings.previous)
        return np.sign(np.where(np.abs(came) > _STILL, came, 0.0))

    def slopes(self, readings: Readings) -> Floats:
        """Return zeros: a direction does not depend on how far."""
        return np.zeros(self.selection.shape)

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say how far the two sides are apart."""
        unit = "mm" if joint.prismatic else "mrad"
        return f"{joint.name} is {2e3 * abs(p[0]):.2g} {unit} apart between approaches from its two sides: backlash"
