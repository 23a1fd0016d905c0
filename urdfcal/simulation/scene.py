"""A robot and its cameras, as planned or as they truly are: from joint values to images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, inverse
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.mechanism import BASE, Tip

if TYPE_CHECKING:
    from urdfcal.cameras.camera import Camera
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.attachments import Attachments


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that decides where an LED appears.

    Attributes:
        chain: the arm.
        placements: (n, 4, 4) its joint placements, used instead of the chain's own. [m]
        frames: what LEDs and cameras are fastened to.
        leds: (L, 3) in the frames they are fixed in. [m]
        T_world_base: (4, 4) where the arm stands. [m]
        cameras: C of them.
        T_cam_frame: (C, 4, 4) in each camera the frame that it is fixed in. [m]
    """

    chain: Mechanism
    placements: Floats
    attachments: Attachments
    leds: Floats
    T_world_base: Floats
    cameras: tuple[Camera, ...]
    T_cam_frame: Floats

    def eyes(self, q: Floats) -> Floats:
        """The cameras' centres (N, C, 3) in the base link's frame at joint values ``q`` (N, n), m."""
        T_base_frame = self._frames(q)[self.attachments.camera]
        return np.asarray(np.swapaxes((T_base_frame @ inverse(self.T_cam_frame)[:, None])[..., :3, 3], 0, 1))

    def fastened(self) -> tuple[list[tuple[int, Floats]], list[tuple[int, Floats]]]:
        """The LEDs, and the cameras' centres: index of the joint that carries each, and its place (3,) there, m."""
        tips = [Tip("world", BASE, inverse(self.T_world_base)), *self.attachments.tips]
        centres = inverse(self.T_cam_frame)[:, :3, 3]
        leds, cameras = (
            [(tips[f].joint, tips[f].T_joint_link[:3, :3] @ p + tips[f].T_joint_link[:3, 3]) for f, p in pairs]
            for pairs in (
                zip(self.attachments.led, self.leds, strict=True),
                zip(self.attachments.camera, centres, strict=True),
            )
        )
        return leds, cameras

    def images(self, q: Floats, *, mirrored: bool = False) -> Floats:
        """Project the LEDs: joint values ``q`` (N, n) -> (N, C, L, 2) px, NaN where a camera cannot see.

        ``mirrored``, their reflections in the plane on which the arm stands.
        """
        points = self._points(q, mirrored=mirrored)
        return np.stack([camera.project(points[:, c]) for c, camera in enumerate(self.cameras)], axis=1)

    def distances(self, q: Floats) -> Floats:
        """From each camera to each LED: (N, C, L) m."""
        return np.asarray(np.linalg.norm(self._points(q), axis=-1))

    def _points(self, q: Floats, *, mirrored: bool = False) -> Floats:
        """(N, C, L, 3) the LEDs in the cameras' frames, m."""
        T_base_frame = self._frames(q)
        leds = np.concatenate([self.leds, np.ones((len(self.leds), 1))], axis=1)
        p_base = (T_base_frame[self.attachments.led] @ leds[:, None, :, None])[..., 0]  # (L, N, 4)
        if mirrored:
            p_base = p_base * [1.0, 1.0, -1.0, 1.0]
        T_cam_base = self.T_cam_frame[:, None] @ inverse(T_base_frame)[self.attachments.camera]  # (C, N, 4, 4)
        points = T_cam_base.swapaxes(0, 1)[:, :, None] @ p_base.swapaxes(0, 1)[:, None, :, :, None]
        return np.asarray(points[..., :3, 0])

    def _frames(self, q: Floats) -> Floats:
        """T_base_frame (F, N, 4, 4) of the world and of the links that carry LEDs or cameras, m."""
        links = link_poses(self.chain, q, self.attachments.tips, self.placements)
        return np.array([np.broadcast_to(inverse(self.T_world_base), (len(q), 4, 4)), *links])


def look_at(position: Floats, target: Floats) -> Floats:
    """T_base_cam (4, 4) of a camera at ``position`` that looks at ``target``, upright as far as that goes.

    Its image's y axis points down along the base frame's z; for a camera that looks along z, along x.
    """
    z = (target - position) / np.linalg.norm(target - position)
    up = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(z, up)) < 1e-6:
        up = np.array([1.0, 0.0, 0.0])
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3] = np.column_stack([x, np.cross(z, x), z, position])
    return T
