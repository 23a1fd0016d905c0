"""Joint placements parameterised in all six directions, instead of by DH rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pinocchio as pin

if TYPE_CHECKING:
    from collections.abc import Iterable

    from urdfcal.arrays import Floats
    from urdfcal.robot.mechanism import Mechanism

AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class PlacementTable:
    """The joints' placements M_i exp6(xi_i), xi_i = (x, y, z, rx, ry, rz) in each joint's own frame.

    The same interface as :class:`~urdfcal.robot.dh.DHTable`. Two directions of every revolute joint and four of every
    prismatic one are redundant: only the tolerances make them unique.

    Attributes:
        columns: the names of an offsets array's columns.
        zeros: empty: a joint whose axis is no coordinate axis has its zero offset spread over three parameters.
        chain: the nominal joints.
    """

    columns: ClassVar[tuple[str, ...]] = AXES
    zeros: ClassVar[tuple[tuple[int, str], ...]] = ()
    chain: Mechanism

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of an offsets array's rows: the joints'."""
        return self.chain.names

    @property
    def parameters(self) -> tuple[tuple[int, str], ...]:
        """(joint index, axis) of every parameter."""
        return tuple((i, axis) for i in range(len(self.chain.joints)) for axis in AXES)

    def reason(self, row: int, name: str) -> str:
        """Say why a parameter is not estimated: only because it was left out."""
        return f"{name} of {self.labels[row]} is not asked for"

    def placements(self, offsets: Floats) -> Floats:
        """Turn (n, 6) offsets into (n, 4, 4) joint placements; a joint without offset keeps its own bit for bit."""
        result = np.array(self.chain.placements)
        for i, xi in enumerate(np.asarray(offsets, dtype=float)):
            if np.any(xi):
                result[i] = result[i] @ pin.exp6(xi).homogeneous
        return result

    def twists(self, offsets: Floats, parameters: Iterable[tuple[int, str]]) -> Floats:
        """Compute the body twists (6 n, p) of the placements: dxi moves M exp6(xi) by exp6(Jexp6(xi) dxi)."""
        offsets = np.asarray(offsets, dtype=float)
        parameters = list(parameters)
        G = np.zeros((6 * len(offsets), len(parameters)))
        for column, (i, axis) in enumerate(parameters):
            G[6 * i : 6 * i + 6, column] = pin.Jexp6(pin.Motion(offsets[i]))[:, AXES.index(axis)]
        return G
