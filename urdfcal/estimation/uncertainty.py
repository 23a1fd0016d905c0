"""How well the calibrated tip is known, wherever the arm goes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.robot.kinematics import tip_motion
from urdfcal.rotations import skew

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.estimation.parameters import Geometry
    from urdfcal.estimation.solver import Solution

# Configurations that stand for the workspace when the base is aligned.
_WORKSPACE = 300


def tip_covariance(table: Geometry, fit: Solution, q: Floats, seed: int = 0) -> Floats:
    """Covariance of the calibrated tip's position in the base link's frame.

    The offsets' covariance carried to the tip, less what a best rigid alignment over the workspace takes away: how
    a robot is bolted down is nothing its URDF could know. The tip's place on the last link counts as drawn.

    Args:
        table: the arm's parameters.
        fit: the estimate.
        q: (N, n) joint values. [rad or m]
        seed: of the configurations that stand for the workspace.

    Returns:
        (N, 3, 3). [m^2]
    """
    workspace = table.chain.random_values(_WORKSPACE, np.random.default_rng(seed))
    A_workspace, rigid_workspace = _motion(table, fit, workspace)
    alignment = np.linalg.lstsq(
        rigid_workspace.reshape(-1, 6), A_workspace.reshape(-1, fit.parameters.count), rcond=None
    )[0]
    A, rigid = _motion(table, fit, np.asarray(q, dtype=float))
    A = A - rigid @ alignment
    result: Floats = A @ fit.covariance @ np.swapaxes(A, 1, 2)
    return result


def _motion(table: Geometry, fit: Solution, q: Floats) -> tuple[Floats, Floats]:
    """How the tip moves with the active parameters (N, 3, count), and with the base as a rigid body (N, 3, 6)."""
    parameters, offsets = fit.parameters, fit.state.offsets
    motion = tip_motion(table.chain, table.chain.build_model(table.placements(offsets)), q)
    A = np.zeros((len(q), 3, parameters.size))
    A[..., : len(parameters.rows)] = (motion.regressor @ table.twists(offsets, parameters.rows))[:, :3]
    rigid = np.concatenate([np.broadcast_to(np.eye(3), (len(q), 3, 3)), -skew(motion.p)], axis=2)
    return A[..., parameters.active], rigid
