"""Where the frames of LEDs and cameras are at every pose, seen from the base link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.estimation.blocks.base_pose import base_keys

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.state import State
    from urdfcal.session.attachments import Attachments


@dataclass(frozen=True, eq=False)
class Links:
    """Poses of the frames that LEDs and cameras are fixed in: 0 is the world of the pose's part, others are links.

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
        """Take the world of each pose's part (N,) beside the links' rotations (N, 3, 3) and origins (N, 3)."""
        T = inverse(np.array([state[key] for key in base_keys(attachments.parts)]))
        T = np.broadcast_to(T[0], (len(part), 4, 4)) if len(T) == 1 else T[part]
        return cls(attachments, (T[:, :3, :3], *R), (T[:, :3, 3], *p))

    @property
    def one_world(self) -> bool:
        """Whether the world is at the same place of the base link at all poses."""
        return len(self.attachments.parts) == 1

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.R[0])
