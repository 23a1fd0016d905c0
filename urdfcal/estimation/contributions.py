"""What was wrong with an arm: how much each joint's geometry, and what each joint does, moves the tip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import rms
from urdfcal.estimation.blocks.arm import ArmBlock
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.uncertainty import aligned_motion
from urdfcal.session.attachments import ends_of_arms

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.arrays import Bools
    from urdfcal.estimation.blocks.base import Block
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution
    from urdfcal.robot.mechanism import Tip

GEOMETRY = "geometry"
"""What the offsets of a joint's own row are called beside the names of joint models."""


@dataclass(frozen=True)
class Contribution:
    """What one cause does to the tip over the workspace.

    Attributes:
        joint: where.
        what: its geometry, or the name of a joint model.
        tip: how far it moves the tip, of several arms the one it moves most, root mean square. [m]
        sigma: standard deviation of that. [m]
    """

    joint: str
    what: str
    tip: float
    sigma: float


def contributions(problem: Problem, fit: Solution) -> tuple[Contribution, ...]:
    """List what each joint contributes to the difference between the nominal and the calibrated arm, the largest first.

    To first order, over the workspace, after the best alignment at the base: as displacements of the tip they add up to
    the whole difference; their root mean squares do not, since they may cancel.

    Args:
        problem: the arm and its joint models.
        fit: the estimate.
    """
    largest: dict[tuple[str, str], Contribution] = {}
    for tip in ends_of_arms(problem.arm.chain, problem.attachments):
        for of in _to_one(problem, fit, tip):
            best = largest.get((of.joint, of.what))
            largest[of.joint, of.what] = of if best is None or of.tip > best.tip else best
    return tuple(sorted(largest.values(), key=lambda of: -of.tip))


def _to_one(problem: Problem, fit: Solution, tip: Tip) -> Iterator[Contribution]:
    A, covariance = aligned_motion(problem, fit, tip=tip), fit.covariance
    for block in fit.parameters.blocks:
        where, active = fit.parameters.active_columns(block.key)
        offsets = block.local(fit.state[block.key])[0] if where.stop > where.start else np.zeros(0)
        for joint, what, mine in _causes(block, active):
            columns = np.arange(where.start, where.stop)[mine[active]]
            moved = A[..., columns] @ offsets[mine & active]
            variance = np.einsum("nij,jk,nik->", A[..., columns], covariance[np.ix_(columns, columns)], A[..., columns])
            size = rms(np.linalg.norm(moved, axis=1))
            yield Contribution(joint, what, size, float(np.sqrt(variance / len(A))))


def _causes(block: Block[Any], active: Bools) -> Iterator[tuple[str, str, Bools]]:
    """The joints that a block is about, what of them, and which of its coordinates that is."""
    if isinstance(block, ArmBlock):
        owners = np.array([block.arm.labels[row] for row, _ in block.rows])
        what = GEOMETRY
    elif isinstance(block, LinearJointModel):
        owners, what = np.array(block.names_of_joints), block.name
    else:
        return
    for joint in dict.fromkeys(owners[active].tolist()) if len(active) else ():
        yield joint, what, owners == joint
