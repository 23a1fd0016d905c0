"""Where joints, links, DH rows, LEDs and cameras are at every pose, in the base link's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from urdfcal.arrays import Floats, inverse
from urdfcal.robot.dh import PARAMETERS, DHTable, row_transform
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.mechanism import BASE, Mechanism, Tip
from urdfcal.robot.tree_dh import Branch, TreeTable
from urdfcal.session.attachments import WORLD

if TYPE_CHECKING:
    from urdfcal.estimation.snapshot import Snapshot
    from urdfcal.result.fitted import FittedCalibration


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """A robot, its LEDs and cameras at N poses, in the base link's frame.

    Attributes:
        frames: (N, n + 1, 4, 4) base link and joint frames. [m]
        T_base_frame: (F, N, 4, 4) what LEDs and cameras are fastened to: the world, then links. [m]
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
        """Run the forward kinematics of one of a calibration's arms at joint values (N, n), in rad or m."""
        fastened, table = calibration.session.attachments, calibration.table
        frames = joint_frames(calibration.chain, calibration.geometry.placements(arm.offsets), q)
        # The world is a link of the base here: it moves with no joint.
        tips = (Tip(WORLD, BASE, inverse(arm.T_world_base)), *fastened.tips)
        T_base_frame = np.array([link_frames(frames, tip) for tip in tips])
        T_base_carrier = np.swapaxes(T_base_frame[fastened.led], 0, 1)
        leds = (T_base_carrier[..., :3, :3] @ arm.leds[..., None])[..., 0] + T_base_carrier[..., :3, 3]
        T_base_cam = T_base_frame[fastened.camera[: len(arm.cameras)]] @ inverse(arm.T_cam_frame)[:, None]
        offsets = arm.offsets if calibration.geometry is table else np.zeros_like(table.nominal)
        return cls(frames, T_base_frame, leds, T_base_cam, place_rows(table, offsets, frames))


class PlacedRows(NamedTuple):
    """R DH rows at N poses, in the base link's frame.

    Attributes:
        frames: (N, R + 1, 4, 4) the DH frames F_0 ... F_R: row i leads to F_i+1. [m]
        corners: (N, R, 3, 3) where each row starts, where its common normal leaves its axis, where it ends: from start
            to foot is d, from foot to end is a. [m]
        lines: (N, K, 3) along each branch's rows: from the carrying link over F_0, foot, F_1, ... to the tip. [m]
        values: (R, 5) the rows with their offsets. [rad, m]
    """

    frames: Floats
    corners: Floats
    lines: list[Floats]
    values: Floats


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


def place_rows(table: DHTable | TreeTable, offsets: Floats, frames: Floats) -> PlacedRows:
    """Find the DH frames at every pose, and the rows between them.

    F_i moves with its joint's link: F_i = L_i K_i^-1 B_i, the joint variable's own offset being part of L_i already. A
    mount's row leads to the first frame of the branch that it carries.

    Args:
        table: the R nominal rows.
        offsets: (R, 5) added to them.
        frames: (N, n + 1, 4, 4) joint frames.
    """
    values = table.nominal + offsets
    dh: list[Floats] = []
    corners: list[Floats] = []
    lines: list[Floats] = []

    def row_between(start: Floats, end: Floats) -> Floats:
        """Add the next row's corners, (N, 3, 3); the last two are its way along the line."""
        foot = end @ inverse(row_transform([0.0, 0.0, *values[len(corners), 2:]]))
        corners.append(np.stack([T[:, :3, 3] for T in (start, foot, end)], axis=1))
        return corners[-1][:, 1:]

    for branch in branches_of(table):
        # The link's origin is where a mount starts; its foot and end come before F_0.
        carrier = frames[:, table.chain.parents[branch.joints[0]] + 1]
        line = [carrier[:, None, :3, 3]]
        if branch.mount is None:
            dh.append(carrier @ branch.table.base)
        else:
            start = carrier @ branch.mount.T_link_start
            end = start @ row_transform(values[len(corners)])
            line.append(row_between(start, end))
            dh.append(end @ branch.mount.T_end_F0)
        line.append(dh[-1][:, None, :3, 3])
        for joint, row, K in zip(branch.joints, branch.table.rows, branch.table.K, strict=True):
            own = np.where([p == row.variable for p in PARAMETERS], row.values, values[len(corners)])
            dh.append(frames[:, joint + 1] @ inverse(K) @ row_transform(own))
            line.append(row_between(dh[-2], dh[-1]))
        line.append((frames[:, branch.joints[-1] + 1] @ branch.table.chain.T_last_tip)[:, None, :3, 3])
        lines.append(np.concatenate(line, axis=1))
    return PlacedRows(np.stack(dh, axis=1), np.stack(corners, axis=1), lines, values)
