"""Flat planes in the world as an unknown: a table or a wall that something touches."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.blocks.base import Block
from urdfcal.estimation.state import Key

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.session.model import Session

PLANES: Key[Floats] = Key("planes")
"""(P, 4) for each plane its unit normal n and its offset d: points with n.p = d. [m]"""


class PlanesBlock(Block["Floats"]):
    """The planes, without priors: each tilts about two axes within itself and moves along its normal."""

    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, session: Session, start: Floats) -> PlanesBlock:
        """Take all planes (P, 4); those that nothing touches are fixed where they are."""
        names, touched = session.named("plane"), session.measured_of("plane")
        return cls(
            key=PLANES,
            names=tuple(f"plane {name}.{part}" for name in names for part in ("tilt_1", "tilt_2", "offset")),
            units=("rad", "rad", "m") * len(names),
            nominal=start,
            sigma=np.full(3 * len(names), np.inf),
            fixed={k: "nothing touches it" for k in range(3 * len(names)) if k // 3 not in touched},
            phrase="where the planes are",
        )

    def retract(self, value: Floats, step: Floats) -> Floats:
        """Tilt the normals and move the planes along them."""
        steps = step.reshape(-1, 3)
        normal = value[:, :3] + np.einsum("pij,pj->pi", tangents(value[:, :3]), steps[:, :2])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.column_stack([normal, value[:, 3] + steps[:, 2]])

    def local(self, value: Floats) -> tuple[Floats, Floats]:
        """Return the tilts of the nominal normals, and how much farther along them the planes are."""
        nominal, across = self.nominal[:, :3], tangents(self.nominal[:, :3])
        along = np.sum(nominal * value[:, :3], axis=1)[:, None]
        tilts = np.einsum("pij,pi->pj", across, value[:, :3]) / along
        by_normal = (np.swapaxes(across, 1, 2) - tilts[..., None] * nominal[:, None]) / along[..., None]
        J, each = np.zeros((len(value), 3, len(value), 3)), np.arange(len(value))
        J[each, :2, each, :2] = by_normal @ tangents(value[:, :3])
        J[each, 2, each, 2] = 1.0
        return np.column_stack([tilts, value[:, 3] - self.nominal[:, 3]]).ravel(), J.reshape(len(self), len(self))


def tangents(normal: Floats) -> Floats:
    """Return two unit vectors (P, 3, 2) across unit normals (P, 3), and across each other."""
    least = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first)], axis=-1)
