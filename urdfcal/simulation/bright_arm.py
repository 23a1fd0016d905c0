"""A light-coloured arm in images: a tube from joint to joint, bright where it faces the camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.mechanism import BASE, Tip

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.simulation.scene import Scene

# Half of what a link of a common arm is wide, and how many bands from rim to middle it is drawn in. [m]
_RADIUS, _BANDS = 0.045, 8
# Edges of an arm in focus are as soft as a lens makes them. [px]
_SOFT = 0.8


def bright_arms(scene: Scene, q: Floats, camera: int) -> list[Floats]:
    """Draw the arm as a camera sees it at joint values ``q`` (N, n): shares (height, width) of its brightness.

    It hides what is behind it, and no LED.
    """
    chain = scene.chain
    tips = [Tip(joint.name, k, np.eye(4)) for k, joint in enumerate(chain.joints)] + list(chain.tips)
    T_base = np.array(link_poses(chain, q, tips, scene.placements))
    above = [*chain.parents, *(tip.joint for tip in chain.tips)]
    frame = int(scene.attachments.camera[camera])
    carriers = [Tip("world", BASE, inverse(scene.T_world_base)), *scene.attachments.tips]
    T_base_frame = link_poses(chain, q, [carriers[frame]], scene.placements)[0]
    T_cam_base = scene.T_cam_frame[camera] @ inverse(T_base_frame)
    images = []
    for pose in range(len(q)):
        points = np.vstack([T_base[:, pose, :3, 3], np.zeros(3)])  # the base link last, as index -1
        p_cam = points @ T_cam_base[pose, :3, :3].T + T_cam_base[pose, :3, 3]
        images.append(_drawn(scene, camera, p_cam, above))
    return images


def _drawn(scene: Scene, camera: int, p_cam: Floats, above: list[int]) -> Floats:
    import cv2

    lens = scene.cameras[camera]
    width, height = lens.resolution
    uv, image = lens.project(p_cam), np.zeros((height, width), np.float32)
    segments = [(k, parent if parent != BASE else len(p_cam) - 1) for k, parent in enumerate(above)]
    # Farthest first: what is nearer is drawn over it.
    for a, b in sorted(segments, key=lambda pair: -float(p_cam[list(pair), 2].mean())):
        if not np.isfinite(uv[[a, b]]).all() or np.abs(uv[[a, b]]).max() > 1e4:
            continue
        half = _RADIUS * float(lens.intrinsics[0]) / float(p_cam[[a, b], 2].mean())
        ends = [tuple(int(value) for value in np.rint(16.0 * uv[k])) for k in (a, b)]
        for part in np.linspace(1.0, 1.0 / _BANDS, _BANDS):
            shade, thick = float(np.sqrt(1.0 - (part - 1.0 / _BANDS) ** 2)), max(1, round(2.0 * part * half))
            cv2.line(image, ends[0], ends[1], shade, thick, cv2.LINE_AA, 4)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _SOFT), dtype=np.float64)
