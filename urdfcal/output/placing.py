"""Where joints, links, LEDs and cameras are at every pose, in the base link's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, inverse
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.mechanism import BASE, Tip
from urdfcal.session.attachments import WORLD

if TYPE_CHECKING:
    from urdfcal.output.fitted import ArmEstimate
    from urdfcal.robot.mechanism import Mechanism
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
        fastened = setup.frames
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
