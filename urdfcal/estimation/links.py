"""Where the frames of LEDs and cameras are at every pose, seen from the base link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import inverse

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.session.attachments import Attachments


@dataclass(frozen=True, eq=False)
class Links:
    """Poses of the frames that LEDs and cameras are fixed in: 0 is the world, the others are links.

    Attributes:
        attachments: what is fixed in which frame.
        R: for each frame (N, 3, 3) its rotation in the base link.
        p: for each frame (N, 3) its origin in the base link. [m]
    """

    attachments: Attachments
    R: tuple[Floats, ...]
    p: tuple[Floats, ...]

    @classmethod
    def of(cls, attachments: Attachments, T_world_base: Floats, R: Sequence[Floats], p: Sequence[Floats]) -> Links:
        """Take the world beside the links' rotations (N, 3, 3) and origins (N, 3)."""
        T, N = inverse(T_world_base), len(R[0]) if R else 1
        world = np.broadcast_to(T[:3, :3], (N, 3, 3)), np.broadcast_to(T[:3, 3], (N, 3))
        return cls(attachments, (world[0], *R), (world[1], *p))

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.R[0])
