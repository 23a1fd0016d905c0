"""Every joint's placement free in all six directions: what DH rows leave out, tamed by priors alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

if TYPE_CHECKING:
    from collections.abc import Iterable

    from urdfcal.arrays import Floats
    from urdfcal.robot.mechanism import Mechanism

AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class PlacementTable:
    """A chain whose joint i is placed by M_i exp6(xi_i), xi_i = (x, y, z, rx, ry, rz) in the joint's own frame.

    The same interface as :class:`~urdfcal.robot.dh.DHTable`. Two directions of every revolute joint and four of every
    prismatic one are redundant: only tolerances share them out.

    Attributes:
        chain: as drawn.
    """

    chain: Mechanism

    @property
    def columns(self) -> tuple[str, ...]:
        """What each column of an offsets array adds to."""
        return AXES

    @property
    def labels(self) -> tuple[str, ...]:
        """What each row of an offsets array belongs to: the joints' names."""
        return self.chain.names

    @property
    def parameters(self) -> tuple[tuple[int, str], ...]:
        """(joint index, axis) of every parameter."""
        return tuple((i, axis) for i in range(len(self.chain.joints)) for axis in AXES)

    @property
    def zeros(self) -> tuple[tuple[int, str], ...]:
        """No single one: a joint whose axis is no coordinate axis has its zero offset spread over three."""
        return ()

    def reason(self, row: int, name: str) -> str:
        """Why a parameter of a row is never a candidate; every one is."""
        return f"{name} of {self.labels[row]} is not asked for"

    def placements(self, offsets: Floats) -> Floats:
        """Turn (n, 6) offsets into (n, 4, 4) joint placements; a joint without offset keeps its own bit for bit."""
        result = np.array(self.chain.placements)
        for i, xi in enumerate(np.asarray(offsets, dtype=float)):
            if np.any(xi):
                result[i] = result[i] @ pin.exp6(xi).homogeneous
        return result

    def twists(self, offsets: Floats, parameters: Iterable[tuple[int, str]]) -> Floats:
        """Body twists (6 n, p) of the placements: a change of xi moves M exp6(xi) by exp6(Jexp6(xi) dxi)."""
        offsets = np.asarray(offsets, dtype=float)
        parameters = list(parameters)
        G = np.zeros((6 * len(offsets), len(parameters)))
        for column, (i, axis) in enumerate(parameters):
            G[6 * i : 6 * i + 6, column] = pin.Jexp6(pin.Motion(offsets[i]))[:, AXES.index(axis)]
        return G
