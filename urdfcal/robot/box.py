"""A box in the base link's frame: how it is written, and which configurations bring the tip into it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import RobotError
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from urdfcal.arrays import Bools, Floats
    from urdfcal.robot.mechanism import Mechanism

_AXES = 3


def parse_box(text: str) -> Floats:
    """Read ``x0:x1,y0:y1,z0:z1`` as the least and largest x, y and z, (3, 2). [m].

    Raises:
        RobotError: it is no box.
    """
    try:
        box = np.array([[float(end) for end in axis.split(":")] for axis in text.split(",")])
    except ValueError:
        box = np.zeros(0)
    if box.shape != (_AXES, 2) or not np.all(np.isfinite(box)) or not np.all(box[:, 0] < box[:, 1]):
        raise RobotError(
            f"{text!r} is no box, no file and no folder",
            where="workspace",
            remedy="Write a box as x0:x1,y0:y1,z0:z1, in metres in the base link's frame, or name a file.",
        )
    return box


def in_box(mechanism: Mechanism, q: Floats, box: Floats) -> Bools:
    """Tell which joint values (N, n) bring the first tip into a box (3, 2), (N,)."""
    p = tip_poses(mechanism, q)[:, :3, 3]
    result: Bools = np.all((p >= box[:, 0]) & (p <= box[:, 1]), axis=1)
    return result
