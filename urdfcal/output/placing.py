"""Where joints, links, DH rows, LEDs and cameras are at every pose, in the base link's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from urdfcal.arrays import Floats, Ints, inverse
from urdfcal.robot.dh import DHTable, row_transform
from urdfcal.robot.flexure import rigid_joints, spread_placements
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.mechanism import BASE, Mechanism, Tip
from urdfcal.session.moves import poses_of_camera

if TYPE_CHECKING:
    from urdfcal.estimation.snapshot import Snapshot
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """A robot, its LEDs and cameras at N poses, in the base link's frame.

    Attributes:
        frames: (N, n + 1, 4, 4) base link and joint frames. [m]
        T_base_frame: (F, N, 4, 4) what LEDs and cameras are fastened to: the world, links, targets. [m]
        leds: (N, L, 3) LEDs. [m]
        T_base_cam: (C, N, 4, 4) cameras. [m]
        rows: the DH rows; the nominal ones where whole placements were estimated.
    """

    frames: Floats
    T_base_frame: Floats
    leds: Floats
    T_base_cam: Floats
    rows: PlacedRows

    @classmethod
    def of(cls, calibration: FittedCalibration, arm: Snapshot, q: Floats) -> RobotPoses:
        """Run one of a calibration's arms' kinematics at joint values (N, n) of its problem's mechanism. [rad, m]."""
        session, table = calibration.session, calibration.table
        fastened, T_base_world = session.attachments, inverse(arm.T_world_bases)
        mechanism = calibration.problem.mechanism
        placements = spread_placements(mechanism, calibration.geometry.placements(arm.offsets))
        frames = joint_frames(mechanism, placements, q)[:, [0, *(rigid_joints(mechanism) + 1)]]
        part = session.part if len(q) == len(session.part) else np.zeros(len(q), np.intp)
        every = [T_base_world[part], *(link_frames(frames, tip) for tip in fastened.tips)]
        every += [every[carrier] @ T for T, (_, carrier) in zip(arm.targets, fastened.carried, strict=True)]
        T_base_frame = np.array(every)
        T_base_carrier = np.swapaxes(T_base_frame[fastened.led], 0, 1)
        leds = (T_base_carrier[..., :3, :3] @ arm.leds[..., None])[..., 0] + T_base_carrier[..., :3, 3]
        seats = [
            T_base_frame[frame] if frame else T_base_world[_parts_of(session, c, part)]
            for c, frame in enumerate(fastened.camera[: len(arm.cameras)])
        ]
        T_base_cam = np.array(seats).reshape(-1, len(q), 4, 4) @ inverse(arm.T_cam_frame)[:, None]
        offsets = arm.offsets if calibration.geometry is table else np.zeros_like(table.nominal)
        return cls(frames, T_base_frame, leds, T_base_cam, place_rows(table, offsets, frames))


class PlacedRows(NamedTuple):
    """R DH rows at N poses, in the base link's frame.

    Attributes:
        frames: (N, R + 1, 4, 4) the DH frames F_0 ... F_R: row i leads to F_i+1. [m]
        corners: (N, R, 3, 3) where each row starts, where its common normal leaves its axis, where it ends: from start
            to foot is d, from foot to end is a. [m]
        lines: (N, K, 3) along each branch's rows: from the carrying row's end and link over F_0, foot, F_1, ... to the
            tip. [m]
        values: (R, 5) the rows with their offsets. [rad, m]
    """

    frames: Floats
    corners: Floats
    lines: list[Floats]
    values: Floats


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


def place_rows(table: DHTable, offsets: Floats, frames: Floats) -> PlacedRows:
    """Find the DH frames at every pose, and the rows between them.

    F_i moves with its joint's link: F_i = L_i K_i^-1 B_i, the joint variable's own offset being part of L_i already. A
    mount's row leads to the first frame of the branch that it carries.

    Args:
        table: the R nominal rows.
        offsets: (R, 5) added to them.
        frames: (N, n + 1, 4, 4) joint frames.
    """
    values, chain = table.nominal + offsets, table.chain
    carried = table.start_frames(frames)
    moved = carried @ row_transform(table.shape(offsets)) @ table.ends
    dh = np.concatenate([frames[:, :1] @ table.base, moved], axis=1)
    starts, ends = dh[:, :-1].copy(), dh[:, 1:].copy()
    mounts = [row.mount for row in table.rows]
    starts[:, mounts] = carried[:, mounts]
    ends[:, mounts] = starts[:, mounts] @ row_transform(values[mounts])
    back = np.array([inverse(row_transform([0.0, 0.0, *row[2:]])) for row in values])
    corners = np.stack([T[..., :3, 3] for T in (starts, ends @ back, ends)], axis=2)
    lines, first, row_of = [], 0, dict[int, int]()
    for branch in chain.branches:
        parent = chain.parents[branch[0]]
        # Of a joint that carries a branch the line of its own goes through the end of its row, and not through its
        # link's origin, where a mount starts; the mount's foot and end come before F_0.
        line = [dh[:, row_of[parent] + 1, None, :3, 3]] if parent in row_of else []
        line.append(frames[:, parent + 1, None, :3, 3])
        if mounts[first]:
            line.append(corners[:, first, 1:])
            first += 1
        last = first + len(branch)
        row_of |= {joint: first + k for k, joint in enumerate(branch)}
        line.append(dh[:, first, None, :3, 3])
        line.append(corners[:, first:last, 1:].reshape(len(dh), -1, 3))
        line.append((frames[:, branch[-1] + 1] @ chain.end_on(branch[-1]))[:, None, :3, 3])
        lines.append(np.concatenate(line, axis=1))
        first = last
    return PlacedRows(dh, corners, lines, values)
