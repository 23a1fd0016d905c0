"""Denavit-Hartenberg rows of a tree of joints: serial tables, each mounted on a link of an earlier one (METHOD 2).

Where a joint carries more than one other, or two arms stand on one base, the further branches begin with a row of
their own, the mount: it leads from an axis of the carrying link's frame to the branch's first joint axis, four numbers
for a line in space. Of the link's three axes the one most across that line is taken, so that no mount is near parallel
and none has a vanishing normal direction (two shoulders in one line, back to back).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen, inverse
from urdfcal.robot.chain import Chain
from urdfcal.robot.dh import PARAMETERS, DHTable, Parameter, line_row, parameter_twists, row_transform
from urdfcal.robot.mechanism import BASE

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from urdfcal.robot.mechanism import Mechanism

MOUNT = ".mount"
"""Suffix of a mount's label, after the name of the branch's first joint."""


@dataclass(frozen=True, eq=False)
class Mount:
    """The DH row from a link to the first axis of the branch that it carries.

    Attributes:
        joint: the branch's first.
        T_link_start: (4, 4) a turn of the carrying link's frame that puts its chosen axis along z.
        values: (5,) of the nominal row, columns as ``PARAMETERS``. [rad, m]
        T_end_F0: (4, 4) from the row's end to the branch's first DH frame: both have z on the axis. [m]
        directed: whether the first joint slides: its axis has a direction, but no position.
    """

    joint: str
    T_link_start: Floats
    values: Floats
    T_end_F0: Floats
    directed: bool

    @property
    def free(self) -> tuple[Parameter, ...]:
        """The parameters that determine the axis."""
        return ("theta", "alpha") if self.directed else ("theta", "d", "a", "alpha")


@dataclass(frozen=True, eq=False)
class Branch:
    """A serial part of a tree, with its DH rows.

    Attributes:
        joints: indices of its joints in the tree.
        table: its rows; the base frame is that of the link that carries it.
        mount: how it hangs there; None for the first branch, which the base pose places.
    """

    joints: tuple[int, ...]
    table: DHTable
    mount: Mount | None


@dataclass(frozen=True, eq=False)
class TreeTable:
    """The DH rows of a tree, branch after branch; the same interface as :class:`~urdfcal.robot.dh.DHTable`.

    A mount's row comes before its branch's rows.

    Attributes:
        chain: the tree that the rows describe.
        branches: its serial parts.
    """

    chain: Mechanism
    branches: tuple[Branch, ...]

    @classmethod
    def from_tree(cls, tree: Mechanism) -> TreeTable:
        """Derive the rows from the axis lines at zero joint values (METHOD 2)."""
        return cls(tree, tuple(_branch(tree, joints) for joints in tree.branches))

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of an offsets array's columns."""
        return PARAMETERS

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The names of an offsets array's rows: of joints, and of the mounts of branches."""
        labels: list[str] = []
        for branch in self.branches:
            labels += [branch.mount.joint + MOUNT] if branch.mount else []
            labels += branch.table.labels
        return tuple(labels)

    @property
    def parameters(self) -> tuple[tuple[int, str], ...]:
        """(row, name) of every parameter that moves a joint and that no other parameter can replace."""
        found: list[tuple[int, str]] = []
        for branch, first in self._parts:
            found += [(first - 1, name) for name in branch.mount.free] if branch.mount else []
            found += [(first + row, name) for row, name in branch.table.parameters]
        return tuple(found)

    @property
    def zeros(self) -> tuple[tuple[int, str], ...]:
        """(row, name) of every joint's zero offset."""
        return tuple((first + row, name) for branch, first in self._parts for row, name in branch.table.zeros)

    @property
    def nominal(self) -> Floats:
        """The nominal rows (R, 5), columns as ``PARAMETERS``. [rad, m]."""
        rows: list[Floats] = []
        for branch in self.branches:
            rows += [branch.mount.values[None]] if branch.mount else []
            rows.append(branch.table.nominal)
        return np.concatenate(rows)

    def reason(self, row: int, name: str) -> str:
        """Say why a parameter of a row is never estimated."""
        for branch, first in self._parts:
            if first <= row < first + len(branch.joints):
                return branch.table.reason(row - first, name)
        return "a mount is a line in space: four numbers, or two for the direction of a sliding joint's"

    def placements(self, offsets: Floats) -> Floats:
        """Turn row offsets (R, 5) into joint placements (n, 4, 4); joints without offsets keep theirs bit for bit.

        Raises:
            RobotError: an offset after the last joint of a branch.
        """
        offsets = np.asarray(offsets, dtype=float)
        result = np.array(self.chain.placements)
        for branch, first in self._parts:
            moved = np.array(branch.table.placements(offsets[first : first + len(branch.joints)]))
            mount = branch.mount
            if mount is not None and np.any(offsets[first - 1]):
                T_link_F0 = mount.T_link_start @ row_transform(mount.values + offsets[first - 1]) @ mount.T_end_F0
                moved[0] = T_link_F0 @ inverse(branch.table.base) @ moved[0]
            result[list(branch.joints)] = moved
        return result

    def twists(self, offsets: Floats, parameters: Iterable[tuple[int, str]]) -> Floats:
        """Compute the body twists (6 n, p) of the placements for each parameter, as :meth:`DHTable.twists`."""
        offsets, parameters = np.asarray(offsets, dtype=float), list(parameters)
        G = np.zeros((len(self.chain.joints), 6, len(parameters)))
        for branch, first in self._parts:
            mine = [k for k, (row, _) in enumerate(parameters) if first <= row < first + len(branch.joints)]
            own = offsets[first : first + len(branch.joints)]
            rows = [(parameters[k][0] - first, parameters[k][1]) for k in mine]
            G[np.ix_(branch.joints, range(6), mine)] = branch.table.twists(own, rows).reshape(len(own), 6, len(mine))
            mount = branch.mount
            if mount is not None:
                # To the right of the mount's row: T_end_F0, the first joint's zero offset, and its own frame.
                Q = mount.T_end_F0 @ inverse(branch.table.base) @ branch.table.placements(own)[0]
                xi = parameter_twists(mount.values + offsets[first - 1], Q)
                for k, (row, name) in enumerate(parameters):
                    if row == first - 1:
                        G[branch.joints[0], :, k] = xi[PARAMETERS.index(name)]
        return G.reshape(6 * len(self.chain.joints), -1)

    @cached_property
    def _parts(self) -> tuple[tuple[Branch, int], ...]:
        """Each branch with the row of its first joint."""
        parts, first = [], 0
        for branch in self.branches:
            first += branch.mount is not None
            parts.append((branch, first))
            first += len(branch.joints)
        return tuple(parts)


def rows_of(mechanism: Mechanism) -> DHTable | TreeTable:
    """Derive the DH rows of a chain, or of a tree (METHOD 2)."""
    return DHTable.from_chain(mechanism) if isinstance(mechanism, Chain) else TreeTable.from_tree(mechanism)


def _branch(tree: Mechanism, joints: Sequence[int]) -> Branch:
    """Derive a run of joints' rows, and the mount that carries it."""
    ends = [tip for tip in tree.tips if tip.joint == joints[-1]]
    parent = tree.parents[joints[0]]
    chain = Chain(
        name=tree.name,
        base_link=tree.base_link if parent == BASE else tree.names[parent],
        tip_link=ends[0].link if ends else tree.names[joints[-1]],
        joints=tuple(tree.joints[i] for i in joints),
        placements=tree.placements[list(joints)],
        T_last_tip=ends[0].T_joint_link if ends else np.eye(4),
    )
    table = DHTable.from_chain(chain)
    return Branch(tuple(joints), table, None if joints[0] == 0 else _mount(table))


def _mount(table: DHTable) -> Mount:
    joint = table.chain.joints[0]
    axis = table.base[:3, 2]
    across = int(np.argmin(np.abs(axis)))
    start = np.eye(4)
    start[:3, :3] = np.roll(np.eye(3), 2 - across, axis=1)  # its z is the link's axis `across`
    point = np.zeros(3) if joint.prismatic else table.base[:3, 3]
    values = line_row(start[:3, :3].T @ point, start[:3, :3].T @ axis)
    T_end_F0 = inverse(start @ row_transform(values)) @ table.base
    return Mount(joint.name, frozen(start), frozen(values), frozen(T_end_F0), joint.prismatic)
