"""An arm before its cameras, as planned or as it truly is: from joint values to images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, inverse
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from urdfcal.robot.chain import Chain
    from urdfcal.vision.camera import Camera


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that decides where an LED appears.

    Attributes:
        chain: the arm.
        placements: (n, 4, 4) its joint placements, used instead of the chain's own. [m]
        leds: (L, 3) in the tip link's frame. [m]
        T_world_base: (4, 4) where the arm stands; the world is the first camera's frame. [m]
        cameras: C of them.
        T_cam_world: (C, 4, 4) where they stand. [m]
    """

    chain: Chain
    placements: Floats
    leds: Floats
    T_world_base: Floats
    cameras: tuple[Camera, ...]
    T_cam_world: Floats

    @property
    def eyes(self) -> Floats:
        """The cameras' centres (C, 3) in the base link's frame, m."""
        return inverse(self.T_cam_world @ self.T_world_base)[:, :3, 3]

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
        T_base_tip = tip_poses(self.chain, q, self.placements)
        if mirrored:
            T_base_tip = np.diag([1.0, 1.0, -1.0, 1.0]) @ T_base_tip
        leds = np.concatenate([self.leds, np.ones((len(self.leds), 1))], axis=1)
        T_world_tip = self.T_world_base @ T_base_tip
        # (N, 1, 1, 4, 4) @ (L, 4, 1), and (C, 1, 4, 4) in between
        points = self.T_cam_world[:, None] @ T_world_tip[:, None, None] @ leds[..., None]
        return np.asarray(points[..., :3, 0])


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
