"""Frames that do not move against each other: the tree of /tf_static."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, inverse
from urdfcal.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Iterable

TF_STATIC = "/tf_static"

# tf2 refuses quaternions that are off by more than this.
_UNIT = 1e-2


class StaticFrames:
    """Where frames hang: below which other frame, and how."""

    def __init__(self, contents: Iterable[Any]) -> None:
        """Take the transforms of tf2_msgs/TFMessage; of a frame that is told twice, the last.

        Raises:
            CameraError: a transform is none.
        """
        self._above: dict[str, tuple[str, Floats]] = {}
        for one in (transform for content in contents for transform in content.transforms):
            self._above[bare(one.child_frame_id)] = bare(one.header.frame_id), _rigid(one)

    def between(self, frame: str, other: str) -> Floats | None:
        """T_frame_other, None where nothing connects them.

        Raises:
            CameraError: a frame hangs on itself.
        """
        (root, T_root_frame), (other_root, T_root_other) = self._root(frame), self._root(other)
        return inverse(T_root_frame) @ T_root_other if root == other_root else None

    def _root(self, frame: str) -> tuple[str, Floats]:
        """The frame at the upper end of the line that ``frame`` hangs on, and T_root_frame."""
        T, passed = np.eye(4), {frame}
        while frame in self._above:
            frame, T_parent_frame = self._above[frame]
            T = T_parent_frame @ T
            if frame in passed:
                raise CameraError(f"the frame {frame!r} hangs on itself", where=TF_STATIC)
            passed.add(frame)
        return frame, T


def bare(frame: str) -> str:
    """A frame's name without the slash that ROS 1 once wrote before it."""
    return frame.removeprefix("/")


def _rigid(transform: Any) -> Floats:
    q, t = transform.transform.rotation, transform.transform.translation
    quaternion = np.array([q.x, q.y, q.z, q.w])
    length, T = float(np.linalg.norm(quaternion)), np.eye(4)
    T[:3, 3] = t.x, t.y, t.z
    if not abs(length - 1.0) < _UNIT or not np.isfinite(T).all():
        raise CameraError(
            f"what is between {transform.header.frame_id!r} and {transform.child_frame_id!r} is no rigid transform",
            where=TF_STATIC,
        )
    T[:3, :3] = pin.Quaternion(quaternion / length).matrix()
    return T
