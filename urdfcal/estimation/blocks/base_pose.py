"""Where the robot stands as an unknown: the base link in the world, anew after every move."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, inverse
from urdfcal.estimation.blocks.base import POSE_AXES, POSE_UNITS, Block
from urdfcal.estimation.state import Key

if TYPE_CHECKING:
    from collections.abc import Sequence

BASE: Key[Floats] = Key("T_world_base")
"""(4, 4) the base link in the world, where it stood first. [m]"""


def base_keys(parts: Sequence[str]) -> tuple[Key[Floats], ...]:
    """Keys of the base link in the world (4, 4) in each part of a session, by the parts' names. [m]."""
    return (BASE, *(Key(f"{name}/{BASE.name}") for name in parts[1:]))


class BaseBlock(Block[Floats]):
    """The rigid transform T_world_base, which moves by exp6(step) from the right, without a prior."""

    order: ClassVar[int] = 9
    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, *, fixed: str | None, key: Key[Floats] = BASE) -> BaseBlock:
        """Take all six coordinates, or fix them for a reason."""
        return cls(
            key=key,
            names=tuple(f"{key.name}.{axis}" for axis in POSE_AXES),
            units=POSE_UNITS,
            nominal=np.eye(4),
            sigma=np.full(6, np.inf),
            fixed={} if fixed is None else dict.fromkeys(range(6), fixed),
            phrase=f"where the robot stands ({key.name})",
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
