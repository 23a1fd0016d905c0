"""The measured domain: the range of each joint's values that a calibration has seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.session.trajectory import REPEAT

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from urdfcal.arrays import Floats
    from urdfcal.robot.mechanism import Mechanism


@dataclass(frozen=True)
class OutsideDomain:
    """A joint that poses take where its calibration has not measured it.

    Attributes:
        joint: its name.
        unit: of its values, rad or m.
        low: least value that was measured in the calibration. [unit]
        high: largest one. [unit]
        beyond: how far the farthest pose is outside. [unit]
        poses: how many are.
    """

    joint: str
    unit: str
    low: float
    high: float
    beyond: float
    poses: int

    def __str__(self) -> str:
        counted = "a pose is" if self.poses == 1 else f"{self.poses} poses are"
        return (
            f"{self.joint} was calibrated from {self.low:.2f} to {self.high:.2f} {self.unit}: {counted} outside, "
            f"by up to {self.beyond:.2g} {self.unit}"
        )


def beyond(mechanism: Mechanism, readings: ArrayLike, domain: Mapping[str, Sequence[float]]) -> Floats:
    """Compute how far readings are outside the ranges that a calibration has measured.

    A joint that turns once more is where it was, and what repeats a measured value is measured.

    Args:
        mechanism: the joints.
        readings: (..., k) values of the actuated joints, in order. [rad or m]
        domain: least and largest value of each joint; of others nothing is said. [rad or m]

    Returns:
        (..., k), zero inside. [rad or m]
    """
    q = np.asarray(readings, dtype=float)
    result = np.zeros(q.shape)
    for j, joint in enumerate(mechanism.actuated_joints):
        if joint.name in domain:
            low, high = domain[joint.name]
            turns = (0.0,) if joint.prismatic else 2.0 * np.pi * np.array([-1.0, 0.0, 1.0])
            shifted = np.add.outer(turns, q[..., j])
            result[..., j] = np.maximum(np.maximum(low - shifted, shifted - high), 0.0).min(axis=0)
    result[result <= REPEAT] = 0.0
    return result


def outside(
    mechanism: Mechanism, readings: ArrayLike, domain: Mapping[str, Sequence[float]]
) -> tuple[OutsideDomain, ...]:
    """Find the joints that readings (N, k) take out of the measured ranges; arguments as of ``beyond``."""
    found = []
    for joint, far in zip(mechanism.actuated_joints, beyond(mechanism, readings, domain).T, strict=True):
        if far.any():
            low, high = domain[joint.name]
            found.append(OutsideDomain(joint.name, joint.unit, low, high, float(far.max()), int(np.count_nonzero(far))))
    return tuple(found)
