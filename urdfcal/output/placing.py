"""Where joints, links, LEDs and cameras are at every pose, in the base link's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, inverse
from urdfcal.robot.mechanism import BASE, Tip
from urdfcal.session.attachments import WORLD

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.estimation.snapshot import Snapshot
    from urdfcal.pipeline import FittedCalibration
    from urdfcal.robot.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class Places:
    """A state's robot, LEDs and cameras at N poses, in the base link's frame.

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
    def of(cls, calibration: FittedCalibration, state: Snapshot, q: Floats) -> Places:
        """Run a state's forward kinematics at joint values (N, n), in rad or m."""
        fastened = calibration.session.attachments
        frames = joint_frames(calibration.geometry, state, q)
        # The world is a link of the base here: it moves with no joint.
        tips = (Tip(WORLD, BASE, inverse(state.T_world_base)), *fastened.tips)
        T_base_frame = np.array([link_frames(frames, tip) for tip in tips])
        leds = led_positions(calibration.chain, frames, state.leds, [tips[frame] for frame in fastened.led])
        seats = T_base_frame[fastened.camera[: len(state.cameras)]]
        return cls(frames, T_base_frame, leds, seats @ inverse(state.T_cam_frame)[:, None])


def joint_frames(arm: ArmParameterization, state: Snapshot, q: Floats) -> Floats:
    """T_base_joint of the base link and every joint at every pose, (N, n + 1, 4, 4) in m."""
    model = arm.chain.build_model(arm.placements(state.offsets))
    data = model.createData()
    T = np.empty((len(q), model.njoints, 4, 4))
    for k, q_k in enumerate(q):
        pin.forwardKinematics(model, data, q_k)
        T[k] = [M.homogeneous for M in data.oMi]
    return T


def link_frames(frames: Floats, tip: Tip) -> Floats:
    """T_base_link (N, 4, 4) of a link, in m, from the joints' frames (N, n + 1, 4, 4)."""
    result: Floats = frames[:, tip.joint + 1] @ tip.T_joint_link
    return result


def led_positions(mechanism: Mechanism, frames: Floats, leds: Floats, tips: Sequence[Tip] = ()) -> Floats:
    """Where every LED is at every pose, (N, L, 3), in m in the base link's frame.

    Args:
        mechanism: the robot.
        frames: (N, n + 1, 4, 4) base link and joint frames. [m]
        leds: (L, 3) in the frames of what carries them. [m]
        tips: what carries each; left out, the tip link carries all.
    """
    carriers = tips or mechanism.tips[:1] * len(leds)
    T = np.stack([link_frames(frames, tip) for tip in carriers], axis=1)
    result: Floats = (T[..., :3, :3] @ leds[..., None])[..., 0] + T[..., :3, 3]
    return result
