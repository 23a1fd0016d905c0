"""Denavit-Hartenberg rows read off the axis lines of a chain or a tree of joints (METHOD 2).

Where a joint carries more than one other, or two arms stand on one base, the further branches begin with a row of
their own, the mount: it leads from an axis of the carrying link's frame to the branch's first joint axis, four numbers
for a line in space. Of the link's three axes the one most across that line is taken, so that no mount is near parallel
and none has a vanishing normal direction (two shoulders in one line, back to back).
"""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen, inverse
from urdfcal.robot.dh import MOUNT, DHRow, DHTable, row_transform
from urdfcal.robot.flexure import without_flexures
from urdfcal.rotations import turn_z_to

if TYPE_CHECKING:
    from urdfcal.robot.mechanism import Joint, Mechanism

__all__ = ["MOUNT", "rows_of"]

# Below this angle between consecutive axes a row is Hayati's. Real UR arms deviate from parallel by up to
# 13 mrad, and the common normal of axes that are almost parallel lies hundreds of metres away; at 0.1 rad
# it lies within ten arm lengths.
PARALLEL_ANGLE = 0.1

# Axes closer than this coincide: the direction of their normal is rounding.
_COINCIDENT = 1e-12
# theta this close to +-pi/2 leaves both signs of x equally small: the sign of a (or alpha) decides.
_TIE = 1e-6


def rows_of(mechanism: Mechanism) -> DHTable:
    """Derive the DH rows of a chain, or of a tree (METHOD 2); flexures have none."""
    return DHTable.from_chain(without_flexures(mechanism))


def derive(mechanism: Mechanism) -> tuple[Floats, tuple[DHRow, ...], Floats, Floats, Floats]:
    """Derive a DH table's base, rows, tool, K and ends from the axis lines at zero joint values."""
    base = F = np.eye(4)
    rows, K, ends = [], [], []
    for branch in mechanism.branches:
        joints = [mechanism.joints[i] for i in branch]
        L = list(accumulate([*mechanism.placements[list(branch)], mechanism.end_on(branch[-1])], np.matmul))
        axes = [T[:3, :3] @ joint.axis for T, joint in zip(L, joints, strict=False)] + [L[-1][:3, 2]]
        F = L[0].copy()
        F[:3, :3] = L[0][:3, :3] @ turn_z_to(joints[0].axis)
        F[:3, 3] = L[0][:3, 3] + axes[0] * (axes[0] @ -L[0][:3, 3])
        if branch[0] == 0:
            base = F
        else:
            start, values = _mount(joints[0], F)
            first = joints[0]
            rows.append(DHRow(first.name, first.type, tuple(values.tolist()), False, first.prismatic, mount=True))
            K.append(inverse(start))
            ends.append(inverse(start @ row_transform(values)) @ F)
        for i, joint in enumerate(joints):
            K.append(inverse(F) @ L[i])
            ends.append(np.eye(4))
            last = i + 1 == len(joints)
            directed = not last and joints[i + 1].prismatic
            point = F[:3, 3] if directed else L[i + 1][:3, 3]
            parallel = bool(np.linalg.norm(np.cross(F[:3, 2], axes[i + 1])) < np.sin(PARALLEL_ANGLE))
            # Every row but the last may choose its height along parallel axes; the last reaches the tip.
            height = float((inverse(F) @ L[-1])[2, 3]) if last else 0.0
            p, w = (inverse(F) @ [*point, 1.0])[:3], F[:3, :3].T @ axes[i + 1]
            values = _hayati_row(p, w, height) if parallel else _line_row(p, w)
            rows.append(DHRow(joint.name, joint.type, tuple(values.tolist()), parallel, directed, last))
            F = F @ row_transform(values)
    return frozen(base), tuple(rows), frozen(inverse(F) @ L[-1]), frozen(K), frozen(ends)


def _mount(joint: Joint, F0: Floats) -> tuple[Floats, Floats]:
    """A turn (4, 4) of a link's frame that puts an axis across joint's along z, and the row (5,) from there."""
    axis = F0[:3, 2]
    across = int(np.argmin(np.abs(axis)))
    start = np.eye(4)
    start[:3, :3] = np.roll(np.eye(3), 2 - across, axis=1)  # its z is the link's axis `across`
    point = np.zeros(3) if joint.prismatic else F0[:3, 3]
    return start, _line_row(start[:3, :3].T @ point, start[:3, :3].T @ axis)


def _line_row(p: Floats, w: Floats) -> Floats:
    """Compute the row (5,) to the line through p along w, not parallel to z; a = 0 where it intersects z."""
    x = np.array([-w[1], w[0], 0.0]) / np.hypot(w[0], w[1])
    d, a, _ = np.linalg.solve(np.column_stack([[0.0, 0.0, 1.0], x, -w]), p)
    if abs(a) < _COINCIDENT:
        a = 0.0
    theta, alpha = np.arctan2(x[1], x[0]), np.arctan2(np.hypot(w[0], w[1]), w[2])
    if _flip(theta, a if a != 0.0 else alpha):
        theta, a, alpha = _wrap(theta + np.pi), -a, -alpha
    return np.array([theta, d, a, alpha, 0.0])


def _hayati_row(p: Floats, w: Floats, d: float) -> Floats:
    """Compute Hayati's row (5,) to the line through p along w, almost parallel to z, with the normal at height d."""
    foot = p + w * ((d - p[2]) / w[2])
    a = np.hypot(foot[0], foot[1])
    theta = np.arctan2(foot[1], foot[0])
    if a < _COINCIDENT:
        theta, a = 0.0, 0.0
    elif _flip(theta, a):
        theta, a = _wrap(theta + np.pi), -a
    w = row_transform([-theta, 0.0, 0.0, 0.0, 0.0])[:3, :3] @ w
    return np.array([theta, d, a, np.arctan2(0.0 - w[1], w[2]), np.arcsin(np.clip(w[0], -1.0, 1.0))])


def _flip(theta: float, positive: float) -> bool:
    """Whether x should point the other way: |theta| smallest, and on a tie ``positive`` positive."""
    if abs(abs(theta) - np.pi / 2) < _TIE:
        return positive < 0.0
    return abs(theta) > np.pi / 2


def _wrap(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
