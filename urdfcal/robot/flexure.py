"""Flexures: what a link that bends does, as two more joints across the joint that it leads to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.robot.mechanism import BASE, Joint
from urdfcal.robot.urdf.urdf import Mimic

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Ints
    from urdfcal.robot.mechanism import Mechanism

ACROSS = ("x", "y")
"""What the two axes are called that a link bends about."""


@dataclass(frozen=True, eq=False)
class Flexure(Joint):
    """An axis across a joint, fixed in the link before it, about which that link bends: a joint without a reading.

    It follows the joint, zero times: whoever knows mimic joints takes it for one that stays at zero.
    """


def with_flexures(mechanism: Mechanism, joints: Sequence[str]) -> Mechanism:
    """Return a mechanism with two flexures before each of some joints, at zero the same.

    Args:
        mechanism: a chain or a tree without flexures.
        joints: names of joints with a reading of their own.
    """
    every: list[Joint] = []
    parents: list[int] = []
    placements: list[Floats] = []
    at = {BASE: BASE}
    for i, (joint, parent, T) in enumerate(zip(mechanism.joints, mechanism.parents, mechanism.placements, strict=True)):
        run = [*_flexures(joint), joint] if joint.name in joints else [joint]
        for k, one in enumerate(run):
            parents.append(len(every) - 1 if k else at[parent])
            placements.append(np.eye(4) if k else T)
            every.append(one)
        at[i] = len(every) - 1
    tips = tuple(replace(tip, joint=at[tip.joint]) for tip in mechanism.tips)
    return replace(mechanism, joints=tuple(every), parents=tuple(parents), placements=np.array(placements), tips=tips)


def rigid_joints(mechanism: Mechanism) -> Ints:
    """Return the indices (n,) of a mechanism's joints without its flexures."""
    return np.array([i for i, joint in enumerate(mechanism.joints) if not isinstance(joint, Flexure)], dtype=np.intp)


def flexures_of(mechanism: Mechanism, joint: str) -> tuple[int, ...]:
    """Return the indices of the two flexures before a joint; none where the link before it does not bend."""
    found = (mechanism.names.index(name) for name in _names(joint) if name in mechanism.names)
    return tuple(found)


def without_flexures(mechanism: Mechanism) -> Mechanism:
    """Return a mechanism as it is drawn, without flexures: the same one where there are none."""
    real = rigid_joints(mechanism).tolist()
    if len(real) == len(mechanism.joints):
        return mechanism
    first = _first(mechanism)
    at = {BASE: BASE} | {joint: k for k, joint in enumerate(real)}
    return replace(
        mechanism,
        joints=tuple(mechanism.joints[i] for i in real),
        parents=tuple(at[mechanism.parents[i]] for i in first),
        placements=np.array([mechanism.placements[i] for i in first]),
        tips=tuple(replace(tip, joint=at[tip.joint]) for tip in mechanism.tips),
    )


def spread_placements(mechanism: Mechanism, placements: Floats) -> Floats:
    """Return the placements (n', 4, 4) of a mechanism with flexures from those (n, 4, 4) of its joints without. [m]."""
    if len(placements) == len(mechanism.joints):
        return placements
    result = np.tile(np.eye(4), (len(mechanism.joints), 1, 1))
    result[_first(mechanism)] = placements
    return frozen(result)


def spread_twists(mechanism: Mechanism, twists: Floats) -> Floats:
    """Return body twists (6 n', p) of all placements from those (6 n, p) of the joints without flexures."""
    if len(twists) == 6 * len(mechanism.joints):
        return twists
    result = np.zeros((6 * len(mechanism.joints), twists.shape[1]))
    rows = 6 * _first(mechanism)[:, None] + np.arange(6)
    result[rows.ravel()] = twists
    return result


def _first(mechanism: Mechanism) -> Ints:
    """Where (n,) the placement of each joint is: at the first of its flexures, if it has any."""
    return np.array([min(i, *flexures_of(mechanism, mechanism.joints[i].name), i) for i in rigid_joints(mechanism)])


def _flexures(joint: Joint) -> list[Joint]:
    """The two flexures of a joint, their axes at right angles to its own."""
    across = np.eye(3)[int(np.argmin(np.abs(joint.axis)))]
    x = across - (across @ joint.axis) * joint.axis
    x /= np.linalg.norm(x)
    axes = x, np.cross(joint.axis, x)
    still = Mimic(joint.name, 0.0, 0.0)
    return [
        Flexure(name, "revolute", frozen(axis), -np.inf, np.inf, still)
        for name, axis in zip(_names(joint.name), axes, strict=True)
    ]


def _names(joint: str) -> tuple[str, ...]:
    return tuple(f"{joint} bends about {axis}" for axis in ACROSS)
