"""Lag: joints stay behind on the side that they came from, by the more the farther they came."""

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


@dataclass(frozen=True, eq=False)
class Lag(LinearJointModel):
    """A joint's error is a share of the way that it came from the pose before: friction's wind-up, or settling.

    A share of 1e-4 is a tenth of a milliradian after a move of one radian, the repeatability that makers of industrial
    arms give (ISO 9283: 0.02 to 0.1 mm at a metre).
    """

    name: ClassVar[str] = "lag"
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"lag": (0,)}
    over: ClassVar[tuple[str, str, str] | None] = ("way that it came", "rad", "m")
    revolute: ClassVar[Prior | None] = Prior("1", 1e-4)
    prismatic: ClassVar[Prior | None] = Prior("1", 1e-4)
    together: ClassVar[bool] = True
    certain: ClassVar[float] = 10.0  # of a rigid Motoman arm it gains up to 9, and a tracker does not confirm it
    at_rest: ClassVar[bool] = True  # of a moving one the cameras\' clocks say the same

    def features(self, readings: Readings) -> Floats:
        """Return the way that the joint came."""
        if readings.previous is None:
            return np.zeros((len(readings.q), len(self)))
        return self.read(readings.q - readings.previous)

    def slopes(self, readings: Readings) -> Floats:
        """Return one for the joint itself, where it is known where it came from."""
        return self.selection * (readings.previous is not None)

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say how much."""
        unit = "mm" if joint.prismatic else "mrad"
        return f"{joint.name} stays behind by {-1e3 * p[0]:.2g} {unit} for each {joint.unit} that it came"

    def sentence_of_all(self, joints: str, most: float) -> str:
        """Say how much."""
        return f"lag of {joints}, by up to {most:.2g} mrad: friction, or settling"
