"""Where the frames of LEDs, targets and cameras are at every pose, seen from the base link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.targets import target_key

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.estimation.state import State
    from urdfcal.session.attachments import Attachments


@dataclass(frozen=True, eq=False)
class Links:
    """Poses of the frames that LEDs, points of targets and cameras are fixed in: the world, links, targets.

    Attributes:
        attachments: what is fixed in which frame.
        R: for each frame (N, 3, 3) its rotation in the base link.
        p: for each frame (N, 3) its origin in the base link. [m]
    """

    attachments: Attachments
    R: tuple[Floats, ...]
    p: tuple[Floats, ...]

    @classmethod
    def of(cls, attachments: Attachments, state: State, R: Sequence[Floats], p: Sequence[Floats]) -> Links:
        """Take the world and the targets of a state beside the links' rotations (N, 3, 3) and origins (N, 3)."""
        T, N = inverse(state[BASE]), len(R[0]) if R else 1
        world = np.broadcast_to(T[:3, :3], (N, 3, 3)), np.broadcast_to(T[:3, 3], (N, 3))
        every_R, every_p = [world[0], *R], [world[1], *p]
        for name, carrier in attachments.carried:
            T = state[target_key(name)]
            every_p.append(every_p[carrier] + every_R[carrier] @ T[:3, 3])
            every_R.append(every_R[carrier] @ T[:3, :3])
        return cls(attachments, tuple(every_R), tuple(every_p))

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.R[0])
