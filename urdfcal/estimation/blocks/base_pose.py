"""Where the robot stands as an unknown: the base link in the world."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, inverse
from urdfcal.estimation.blocks.base import POSE_AXES, POSE_UNITS, Block
from urdfcal.estimation.state import Key

BASE: Key[Floats] = Key("T_world_base")
"""(4, 4) the base link in the world. [m]"""


class BaseBlock(Block[Floats]):
    """The rigid transform T_world_base, which moves by exp6(step) from the right, without a prior."""

    order: ClassVar[int] = 9
    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, *, fixed: str | None) -> BaseBlock:
        """Take all six coordinates, or fix them for a reason."""
        return cls(
            key=BASE,
            names=tuple(f"T_world_base.{axis}" for axis in POSE_AXES),
            units=POSE_UNITS,
            nominal=np.eye(4),
            sigma=np.full(6, np.inf),
            fixed={} if fixed is None else dict.fromkeys(range(6), fixed),
            phrase="where the robot stands (T_world_base)",
        )

    def retract(self, value: Floats, step: Floats) -> Floats:
        """Multiply by exp6(step) from the right."""
        moved: Floats = value @ pin.exp6(step).homogeneous
        return moved

    def between(self, a: Floats, b: Floats) -> Floats:
        """Return the step that leads from one pose to another."""
        step: Floats = pin.log6(inverse(a) @ b).vector
        return step

    def local(self, value: Floats) -> tuple[Floats, Floats]:
        """Without a prior there is nothing to differ from."""
        del value
        return np.zeros(6), np.eye(6)
