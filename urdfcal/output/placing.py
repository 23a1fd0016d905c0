"""Where joints, links, DH rows, LEDs and cameras are at every pose, in the base link's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, Ints, inverse
from urdfcal.robot.dh import row_transform
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.mechanism import BASE, Tip
from urdfcal.session.moves import poses_of_camera

if TYPE_CHECKING:
    from urdfcal.output.fitted import ArmEstimate
    from urdfcal.robot.dh import DHTable
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """A robot, its LEDs and cameras at N poses, in the base link's frame.

    Attributes:
        frames: (N, n + 1, 4, 4) base link and joint frames. [m]
        T_base_frame: (F, N, 4, 4) what LEDs and cameras are fastened to: the world, links, targets. [m]
        leds: (N, L, 3) LEDs. [m]
        T_base_cam: (C, N, 4, 4) cameras. [m]
    """

    frames: Floats
    T_base_frame: Floats
    leds: Floats
    T_base_cam: Floats

    @classmethod
    def of(cls, session: Session, arm: ArmEstimate, q: Floats) -> RobotPoses:
        """Run an arm's forward kinematics at joint values (N, n), in rad or m: those of the session, or others."""
        fastened, T_base_world = session.attachments, inverse(arm.T_world_bases)
        frames = joint_frames(session.chain, arm.placements, q)
        part = session.part if len(q) == len(session.part) else np.zeros(len(q), np.intp)
        every = [T_base_world[part], *(link_frames(frames, tip) for tip in fastened.tips)]
        every += [every[carrier] @ T for T, (_, carrier) in zip(arm.targets, fastened.carried, strict=True)]
        T_base_frame = np.array(every)
        T_base_carrier = np.swapaxes(T_base_frame[fastened.led], 0, 1)
        leds = (T_base_carrier[..., :3, :3] @ arm.leds[..., None])[..., 0] + T_base_carrier[..., :3, 3]
        seats = np.array(
            [
                T_base_frame[frame] if frame else T_base_world[_parts_of(session, c, part)]
                for c, frame in enumerate(fastened.camera[: len(arm.cameras)])
            ]
        ).reshape(-1, len(q), 4, 4)
        return cls(frames, T_base_frame, leds, seats @ inverse(arm.T_cam_frame)[:, None])


def _parts_of(session: Session, camera: int, part: Ints) -> Ints:
    """In whose world (N,) a standing camera is at each pose: of a part in which it saw nothing, in another's."""
    used = np.unique(session.part[poses_of_camera(session, camera)])
    return np.where(np.isin(part, used), part, used[0]) if len(used) else part


def joint_frames(mechanism: Mechanism, placements: Floats, q: Floats) -> Floats:
    """T_base_joint (N, n + 1, 4, 4) of the base link and every joint at every pose, in m."""
    frames = [Tip("", joint, np.eye(4)) for joint in range(BASE, len(mechanism.joints))]
    return np.stack(link_poses(mechanism, q, frames, placements), axis=1)


def link_frames(frames: Floats, tip: Tip) -> Floats:
    """T_base_link (N, 4, 4) of a link, in m, from the joints' frames (N, n + 1, 4, 4)."""
    result: Floats = frames[:, tip.joint + 1] @ tip.T_joint_link
    return result


def dh_frames(table: DHTable, offsets: Floats, frames: Floats) -> Floats:
    """T_base_F of the DH frames F_0 ... F_R at every pose, (N, R + 1, 4, 4) in m: row i leads to F_i+1.

    F_i moves with its joint's link: F_i = L_i K_i^-1 B_i, the joint variable's own offset being part of L_i already. A
    mount's row leads to the first frame of the branch that it carries.

    Args:
        table: the R nominal rows.
        offsets: (R, 5) added to them.
        frames: (N, n + 1, 4, 4) joint frames.
    """
    ends = table.start_frames(frames) @ row_transform(table.shape(offsets)) @ table.ends
    return np.concatenate([frames[:, :1] @ table.base, ends], axis=1)


def row_corners(table: DHTable, offsets: Floats, frames: Floats, dh: Floats) -> Floats:
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
    mounts = [row.mount for row in table.rows]
    starts[:, mounts] = table.start_frames(frames)[:, mounts]
    ends[:, mounts] = starts[:, mounts] @ row_transform(values[mounts])
    back = np.array([inverse(row_transform([0.0, 0.0, *row[2:]])) for row in values])
    return np.stack([T[..., :3, 3] for T in (starts, ends @ back, ends)], axis=2)


def row_lines(table: DHTable, offsets: Floats, frames: Floats) -> list[Floats]:
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
    chain, lines = table.chain, []
    first = 0
    for branch in chain.branches:
        # The link's origin is where a mount starts; its foot and end come before F_0.
        parts = [frames[:, chain.parents[branch[0]] + 1, None, :3, 3]]
        if table.rows[first].mount:
            parts.append(corners[:, first, 1:])
            first += 1
        last = first + len(branch)
        parts.append(dh[:, first, None, :3, 3])
        parts.append(corners[:, first:last, 1:].reshape(len(dh), -1, 3))
        parts.append((frames[:, branch[-1] + 1] @ chain.end_on(branch[-1]))[:, None, :3, 3])
        lines.append(np.concatenate(parts, axis=1))
        first = last
    return lines
