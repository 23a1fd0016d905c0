"""Verification of a corrected URDF: two independent readers must see the calibrated arm move."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.robot.chain import Chain, read_mechanism
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.robot.mechanism import Mechanism

# Forward kinematics of the URDF that was written against the estimate. [m, entries of the rotation]
_AGREEMENT = 1e-9
_CHECK_POSES = 20


def verify_urdf(data: bytes, of: FittedCalibration) -> None:
    """Read a URDF with Pinocchio and yourdfpy, and compare both, and the DH rows, with the calibrated arm.

    Args:
        data: the URDF's text.
        of: the calibration that it was written for.

    Raises:
        OutputError: a reader, or the DH rows, place a tip elsewhere at random joint values.
    """
    chain, table = of.chain, of.table
    q = chain.random_values(_CHECK_POSES, np.random.default_rng(of.seed))
    expected = np.array(link_poses(chain, q, chain.tips, of.placements))
    again = read_mechanism(Urdf.parse(data), [tip.link for tip in chain.tips], chain.base_link)
    tips = {"Pinocchio": np.array(link_poses(again, q, again.tips)), "yourdfpy": _yourdfpy_links(data, chain, q)}
    if of.geometry is table and isinstance(chain, Chain):
        tips["the DH rows"] = np.array([[table.forward(q_k, of.estimate.offsets) for q_k in q]])
    for reader, T in tips.items():
        error = float(np.abs(T - expected).max())
        if not error <= _AGREEMENT:
            raise OutputError(
                f"the corrected URDF moves differently when read by {reader}: {error:.1e} m or in the rotation",
                where=of.session.urdf_reference,
                remedy="This is a defect of urdfcal; please report it with the URDF.",
            )


def _yourdfpy_links(data: bytes, chain: Mechanism, q: Floats) -> Floats:
    """T_base_link (tips, N, 4, 4) by yourdfpy, which shares no code with Pinocchio."""
    import io

    import yourdfpy

    robot = yourdfpy.URDF.load(io.BytesIO(data), load_meshes=False, build_scene_graph=True)
    for joint in robot.joint_map.values():  # it takes a sliding joint's axis as long as it is written
        if joint.axis is not None and np.any(joint.axis):
            joint.axis = np.asarray(joint.axis) / np.linalg.norm(joint.axis)
    names = [joint.name for joint in robot.actuated_joints]
    result = np.empty((len(chain.tips), len(q), 4, 4))
    for k, q_k in enumerate(q):
        values = dict(zip(chain.names, q_k, strict=True))
        robot.update_cfg([values.get(name, 0.0) for name in names])
        for i, tip in enumerate(chain.tips):
            result[i, k] = robot.get_transform(tip.link, chain.base_link)
    return result
