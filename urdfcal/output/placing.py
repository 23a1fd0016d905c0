"""Where joints, links, DH rows, LEDs and cameras are at every pose, in the base link's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, inverse
from urdfcal.robot.dh import PARAMETERS, DHTable, row_transform
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.mechanism import BASE, Tip
from urdfcal.robot.tree_dh import Branch
from urdfcal.session.attachments import WORLD

if TYPE_CHECKING:
    from urdfcal.output.fitted import ArmEstimate
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.tree_dh import TreeTable
    from urdfcal.session.model import Setup


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """A robot, its LEDs and cameras at N poses, in the base link's frame.

    Attributes:
        frames: (N, n + 1, 4, 4) base link and joint frames. [m]
        T_base_frame: (F, N, 4, 4) what LEDs and cameras are fastened to: the world, then links. [m]
        leds: (N, L, 3) LEDs. [m]
        T_base_cam: (C, N, 4, 4) cameras. [m]
    """

    frames: Floats
    T_base_frame: Floats
    leds: Floats
    T_base_cam: Floats

    @classmethod
    def of(cls, setup: Setup, arm: ArmEstimate, q: Floats) -> RobotPoses:
        """Run an arm's forward kinematics at joint values (N, n), in rad or m."""
        fastened = setup.attachments
        frames = joint_frames(setup.chain, arm.placements, q)
        # The world is a link of the base here: it moves with no joint.
        tips = (Tip(WORLD, BASE, inverse(arm.T_world_base)), *fastened.tips)
        T_base_frame = np.array([link_frames(frames, tip) for tip in tips])
        T_base_carrier = np.swapaxes(T_base_frame[fastened.led], 0, 1)
        leds = (T_base_carrier[..., :3, :3] @ arm.leds[..., None])[..., 0] + T_base_carrier[..., :3, 3]
        seats = T_base_frame[fastened.camera[: len(arm.cameras)]]
        return cls(frames, T_base_frame, leds, seats @ inverse(arm.T_cam_frame)[:, None])


def joint_frames(mechanism: Mechanism, placements: Floats, q: Floats) -> Floats:
    """T_base_joint (N, n + 1, 4, 4) of the base link and every joint at every pose, in m."""
    frames = [Tip("", joint, np.eye(4)) for joint in range(BASE, len(mechanism.joints))]
    return np.stack(link_poses(mechanism, q, frames, placements), axis=1)


def link_frames(frames: Floats, tip: Tip) -> Floats:
    """T_base_link (N, 4, 4) of a link, in m, from the joints' frames (N, n + 1, 4, 4)."""
    result: Floats = frames[:, tip.joint + 1] @ tip.T_joint_link
    return result


def branches_of(table: DHTable | TreeTable) -> tuple[Branch, ...]:
    """The serial parts of a table; a serial one has one."""
    if isinstance(table, DHTable):
        return (Branch(tuple(range(len(table.rows))), table, None),)
    return table.branches


def dh_frames(table: DHTable | TreeTable, offsets: Floats, frames: Floats) -> Floats:
    """T_base_F of the DH frames F_0 ... F_R at every pose, (N, R + 1, 4, 4) in m: row i leads to F_i+1.

    F_i moves with its joint's link: F_i = L_i K_i^-1 B_i, the joint variable's own offset being part of L_i already. A
    mount's row leads to the first frame of the branch that it carries.

    Args:
        table: the R nominal rows.
        offsets: (R, 5) added to them.
        frames: (N, n + 1, 4, 4) joint frames.
    """
    T = np.empty((len(frames), len(offsets) + 1, 4, 4))
    end = 0
    for branch in branches_of(table):
        carrier, mount = _carrier(table, branch, frames), branch.mount
        if mount is None:
            T[:, end] = carrier @ branch.table.base
        else:
            end += 1
            T[:, end] = carrier @ mount.T_link_start @ row_transform(mount.values + offsets[end - 1]) @ mount.T_end_F0
        for joint, row, K in zip(branch.joints, branch.table.rows, branch.table.K, strict=True):
            own = np.where([p == row.variable for p in PARAMETERS], 0.0, offsets[end])
            end += 1
            T[:, end] = frames[:, joint + 1] @ inverse(K) @ row_transform(np.add(row.values, own))
    return T


def row_corners(table: DHTable | TreeTable, offsets: Floats, frames: Floats, dh: Floats) -> Floats:
    """Where every row starts, where its common normal leaves its own axis, and where it ends.

    From start to foot is d, from foot to end is a.

    Args:
        table: the R nominal rows.
        offsets: (R, 5) added to them.
        frames: (N, n + 1, 4, 4) joint frames.
        dh: (N, R + 1, 4, 4) DH frames with these offsets.

    Returns:
        (N, R, 3, 3) three corners each, in m in the base link's frame.
    """
    values = table.nominal + offsets
    starts, ends = dh[:, :-1].copy(), dh[:, 1:].copy()
    first = 0
    for branch in branches_of(table):
        if branch.mount is not None:
            starts[:, first] = _carrier(table, branch, frames) @ branch.mount.T_link_start
            ends[:, first] = starts[:, first] @ row_transform(values[first])
            first += 1
        first += len(branch.joints)
    back = np.array([inverse(row_transform([0.0, 0.0, *row[2:]])) for row in values])
    return np.stack([T[..., :3, 3] for T in (starts, ends @ back, ends)], axis=2)


def row_lines(table: DHTable | TreeTable, offsets: Floats, frames: Floats) -> list[Floats]:
    """A line along each branch's rows: from the carrying link over F_0, foot, F_1, ... to the tip.

    Args:
        table: the R nominal rows.
        offsets: (R, 5) added to them.
        frames: (N, n + 1, 4, 4) joint frames.

    Returns:
        (N, K, 3) for each branch, in m in the base link's frame.
    """
    dh = dh_frames(table, offsets, frames)
    corners = row_corners(table, offsets, frames, dh)
    lines = []
    first = 0
    for branch in branches_of(table):
        # The link's origin is where a mount starts; its foot and end come before F_0.
        parts = [_carrier(table, branch, frames)[:, None, :3, 3]]
        if branch.mount is not None:
            parts.append(corners[:, first, 1:])
            first += 1
        last = first + len(branch.joints)
        parts.append(dh[:, first, None, :3, 3])
        parts.append(corners[:, first:last, 1:].reshape(len(dh), -1, 3))
        parts.append((frames[:, branch.joints[-1] + 1] @ branch.table.chain.T_last_tip)[:, None, :3, 3])
        lines.append(np.concatenate(parts, axis=1))
        first = last
    return lines


def _carrier(table: DHTable | TreeTable, branch: Branch, frames: Floats) -> Floats:
    """T_base_link (N, 4, 4) of the link that carries a branch."""
    result: Floats = frames[:, table.chain.parents[branch.joints[0]] + 1]
    return result
