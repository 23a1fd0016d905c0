"""Where the frames of LEDs, targets and cameras are at every pose, seen from the base link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.estimation.blocks.base_pose import base_keys
from urdfcal.estimation.blocks.targets import target_key

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.state import State
    from urdfcal.session.attachments import Attachments


@dataclass(frozen=True, eq=False)
class Links:
    """Poses of the frames that LEDs, points of targets and cameras are fixed in: world, links, targets.

    Frame 0 is the world of the pose's part.

    Attributes:
        attachments: what is fixed in which frame.
        R: for each frame (N, 3, 3) its rotation in the base link.
        p: for each frame (N, 3) its origin in the base link. [m]
    """

    attachments: Attachments
    R: tuple[Floats, ...]
    p: tuple[Floats, ...]

    @classmethod
    def of(cls, attachments: Attachments, state: State, part: Ints, R: Sequence[Floats], p: Sequence[Floats]) -> Links:
        """Take the world of each pose's part (N,) and the targets beside the links' rotations and origins (N, ...)."""
        T = inverse(np.array([state[key] for key in base_keys(attachments.parts)]))
        T = np.broadcast_to(T[0], (len(part), 4, 4)) if len(T) == 1 else T[part]
        every_R, every_p = [T[:, :3, :3], *R], [T[:, :3, 3], *p]
        for name, carrier in attachments.carried:
            own = state[target_key(name)]
            every_p.append(every_p[carrier] + every_R[carrier] @ own[:3, 3])
            every_R.append(every_R[carrier] @ own[:3, :3])
        return cls(attachments, tuple(every_R), tuple(every_p))

    @property
    def one_world(self) -> bool:
        """Whether the world is at the same place of the base link at all poses."""
        return len(self.attachments.parts) == 1

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.R[0])
