"""Where the recording's views in space look from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.output.scene import CalibrationScene

# rerun's eye opens 55 degrees high; on a laptop's screen the view is at least so much wider than high.
_HALF_VIEW = np.radians(55 / 2)
_ASPECT = 1.2


def viewpoint(scene: CalibrationScene) -> tuple[Floats, Floats]:
    """Find a place from which the arm and its LEDs fill the view, with the cameras to one side, wherever they are.

    Returns:
        The eye and the point it looks at, (3,) each, in the base link's frame. [m]
    """
    arm = scene.frames[..., :3, 3].reshape(-1, 3)
    cameras = scene.views[..., :3, 3].reshape(-1, 3)
    return eye_on(arm, cameras, np.concatenate([arm, scene.leds.measured[~scene.leds.outlier]]))


def eye_on(arm: Floats, cameras: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Find a place from which points fill the view, with cameras to one side of an arm, (N, 3) each. [m].

    Returns:
        The eye and the point it looks at, (3,) each. [m]
    """
    towards = cameras.mean(axis=0) - arm.mean(axis=0) if len(cameras) else np.zeros(3)
    across = np.array([towards[1], -towards[0], 0.0])
    if not np.linalg.norm(across) > 0.0:
        across = np.array([1.0, 0.0, 0.0])
    return filling(points, -(across / np.linalg.norm(across) + [0.0, 0.0, 0.4]))  # and somewhat down


def filling(points: Floats, forward: Floats, aspect: float = _ASPECT) -> tuple[Floats, Floats]:
    """Find a place from which points (N, 3) fill the view in a direction. [m].

    Args:
        points: to be seen.
        forward: (3,) the direction.
        aspect: how wide the view is for its height, at least.

    Returns:
        The eye and the point it looks at, (3,) each. [m]
    """
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = points - target
    wide, high = np.abs(away @ right) / aspect, np.abs(away @ np.cross(right, forward))
    distance = float(np.max(np.maximum(wide, high) / np.tan(_HALF_VIEW) - away @ forward))
    return target - 1.1 * distance * forward, target


def around(points: Floats, towards: Floats) -> tuple[Floats, Floats]:
    """Find a place in a direction from which all points (N, 3) are in the view. [m].

    Args:
        points: to be seen.
        towards: (3,) from their middle to the eye.

    Returns:
        The eye and the point it looks at, (3,) each. [m]
    """
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    far = 1.05 * float(np.linalg.norm(points - middle, axis=1).max()) / np.sin(_HALF_VIEW)
    return middle + far * towards / np.linalg.norm(towards), middle
