"""What stands around the arm, as boxes that it keeps clear of."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from urdfcal.arrays import Floats, finite_array, keep
from urdfcal.errors import SessionError
from urdfcal.rotations import rpy_to_matrix


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A box that stands still.

    Attributes:
        name: of it.
        size: (3,) along its own axes. [m]
        position: (3,) of its middle, in the base link's frame. [m]
        rpy: (3,) of its axes there. [rad]
    """

    name: str
    size: Floats
    position: Floats
    rpy: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        where = f"scene.{self.name}"
        keep(self, **{of: finite_array(getattr(self, of), (3,), of, where) for of in ("size", "position", "rpy")})
        if not np.all(self.size > 0.0):
            raise SessionError(f"size {self.size.tolist()} is not positive", where=where)

    @property
    def T_base_box(self) -> Floats:
        """(4, 4) its middle in the base link's frame. [m]."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rpy_to_matrix(self.rpy), self.position
        return T
