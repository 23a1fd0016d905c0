"""The arm's geometry as an unknown: offsets of its DH rows, or of whole joint placements."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from urdfcal.estimation.blocks.base import VectorBlock
from urdfcal.estimation.state import Key

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.knowledge import Tolerances

ARM: Key[Floats] = Key("arm")
"""(rows, columns) offsets of the arm's parameterisation. [rad, m]"""

LENGTHS = ("d", "a", "x", "y", "z")
"""The parameters in metres; the others are angles."""

# Where a direction is unidentifiable, the first of these that takes part is fixed, inner rows first (METHOD 11).
_ORDER = ("d", "a", "theta", "alpha", "beta", "z", "x", "y", "rz", "rx", "ry")


class ArmParameterization(Protocol):
    """Parameters of an arm's geometry: DH rows of a chain or a tree, or whole placements (METHOD 2)."""

    @property
    def chain(self) -> Mechanism:
        """The joints with their nominal placements."""

    @property
    def columns(self) -> tuple[str, ...]:
        """What each column of an offsets array adds to."""

    @property
    def labels(self) -> tuple[str, ...]:
        """What each row of an offsets array belongs to: a joint, or the mount of a branch."""

    @property
    def parameters(self) -> tuple[tuple[int, str], ...]:
        """(row index, column name) of every parameter."""

    @property
    def zeros(self) -> tuple[tuple[int, str], ...]:
        """Those of them that are joints' zero offsets."""

    def reason(self, row: int, name: str) -> str:
        """Why a parameter of a row is never a candidate."""

    def placements(self, offsets: Floats) -> Floats:
        """Joint placements (n, 4, 4) under offsets (rows, columns)."""

    def twists(self, offsets: Floats, parameters: Iterable[tuple[int, str]]) -> Floats:
        """Body twists (6 n, p) of the placements for each parameter."""


def no_offsets(arm: ArmParameterization) -> Floats:
    """Offsets (rows, columns) of the nominal arm."""
    return np.zeros((len(arm.labels), len(arm.columns)))


def zero_rows(arm: ArmParameterization) -> dict[str, tuple[int, int]]:
    """Row and column of each joint's zero offset in an offsets array, by the joint's name."""
    return {arm.labels[row]: (row, arm.columns.index(name)) for row, name in arm.zeros}


def parameter_tolerance(tolerances: Tolerances, joint: str, name: str, *, zero: bool) -> float:
    """Tolerance of one parameter of a row: the row's own, else that of its kind. [rad or m]."""
    by_kind = tolerances.length if name in LENGTHS else tolerances.angle
    default = tolerances.zero if zero else by_kind
    return tolerances.joints.get(joint, {}).get(name, default)


@dataclass(frozen=True, eq=False)
class ArmBlock(VectorBlock):
    """Offsets of an arm's parameterisation, with manufacturing tolerances as priors.

    Attributes:
        arm: the parameterisation.
        rows: (row index, column name) of each coordinate.
    """

    arm: ArmParameterization = field(kw_only=True)
    rows: tuple[tuple[int, str], ...] = field(kw_only=True)

    toleranced: ClassVar[bool] = True
    order: ClassVar[int] = 0
    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, arm: ArmParameterization, tolerances: Tolerances, *, priors: bool) -> ArmBlock:
        """Take every parameter of an arm; those of tolerance 0 are fixed.

        Args:
            arm: the parameterisation.
            tolerances: of the robot.
            priors: whether the tolerances act as priors.
        """
        zeros, rows = set(arm.zeros), tuple(arm.parameters)
        sigma = np.array(
            [parameter_tolerance(tolerances, arm.labels[i], name, zero=(i, name) in zeros) for i, name in rows]
        )
        return cls(
            key=ARM,
            names=tuple(f"{arm.labels[i]}.{name}" for i, name in rows),
            units=tuple("m" if name in LENGTHS else "rad" for _, name in rows),
            nominal=no_offsets(arm),
            sigma=np.where((sigma > 0.0) & priors, sigma, np.inf),
            fixed={int(k): "fixed by the session's tolerances" for k in np.flatnonzero(sigma == 0.0)},
            phrase="the arm's geometry",
            arm=arm,
            rows=rows,
        )

    def retract(self, value: Floats, step: Floats) -> Floats:
        """Add the step to the offsets of the rows."""
        moved = np.array(value)
        moved[self.places] += step
        return moved

    def local(self, value: Floats) -> tuple[Floats, Floats]:
        """Return the offsets of the rows, and the identity."""
        return (value - self.nominal)[self.places], np.eye(len(self))

    def label(self, index: int) -> str:
        """Name a parameter by its row and joint."""
        row, name = self.rows[index]
        return f"{name} of row {row + 1} ({self.arm.labels[row]})"

    def priority(self, index: int) -> tuple[int, ...]:
        """Order by the kind of parameter, then by row."""
        row, name = self.rows[index]
        return (_ORDER.index(name), row)

    def unidentifiable(self, index: int, partners: Sequence[int]) -> str | None:
        """Parameters of one kind on parallel axes only appear as a sum."""
        if not partners:
            return f"{self.label(index)} moves nothing that is measured (an LED on the last axis hides it)"
        if any(self.rows[k][1] != self.rows[index][1] for k in partners):
            return None
        others = " and ".join(self.label(k) for k in partners)
        return f"{self.label(index)} and {others} only appear as a sum (their axes are parallel)"

    @property
    def places(self) -> tuple[list[int], list[int]]:
        """Row and column of each coordinate in an offsets array."""
        return [row for row, _ in self.rows], [self.arm.columns.index(name) for _, name in self.rows]
