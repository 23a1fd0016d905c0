"""MuJoCo: the calibrated placements in an existing model of the same robot.

Body i of joint i is placed anew by

    S_i' = S_i M_i(-ref) C_i (D_i^-1 B_i) C_i^-1 M_i(ref),

S_i its place in the file, M_i(value) what its joint does to it, C_i the URDF link's frame in the body's, and D_i and
B_i the joint's placement as drawn and as built.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Floats, inverse
from urdfcal.errors import OutputError, RobotError
from urdfcal.output.exports.mjcf_bodies import match
from urdfcal.output.exports.mjcf_text import Mjcf
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.mechanism import BASE

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from urdfcal.output.exports.mjcf_bodies import Match
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.urdf.urdf import Urdf

# MuJoCo's kinematics and ours round differently. [m, entries of the rotation]
_AGREEMENT = 1e-9
# What a file of rounded numbers is off before, it may be off after, and a little more for other directions.
_CARRIED = 2.0
_CHECK_POSES = 20


def mjcf(calibration: Calibration, urdf: Urdf, path: Path) -> dict[str, bytes]:
    """Give the bodies of a MuJoCo file the calibrated placements; of its text only their pos and orientation change.

    Args:
        calibration: the result.
        urdf: of the calibrated robot, for the links that are fixed to its base.
        path: the MuJoCo file; joints are found by name.

    Returns:
        The new file, by name; it finds its meshes from the folder of the old one.

    Raises:
        OutputError: the package mujoco is missing, or the new file does not move as it should.
        RobotError: it is no MuJoCo file, cannot be edited truthfully, or is of another robot.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RobotError(f"cannot be read: {error.strerror}", where=str(path)) from error
    text, model = Mjcf.parse(data, str(path)), _compiled(data, path)
    chain, built = calibration.chain, calibration.placements
    found = match(model, chain, built, urdf, str(path))
    for name in (name for name in chain.names if name not in text.bodies):
        raise RobotError(
            f"joint {name!r} is not written out in this file",
            where=str(path),
            remedy="Write its body without <replicate> or <attach>.",
        )
    before = {body.joint.name: body.place for body in found.bodies}
    after = dict(before)
    for body, C, D, B in zip(found.bodies, found.T_body_link, chain.placements, built, strict=True):
        if not np.array_equal(D, B):
            to_link = body.motion(-body.ref) @ C
            after[body.joint.name] = body.place @ to_link @ inverse(D) @ B @ inverse(to_link)
    written = text.with_places(before, after)
    _check(calibration, found, model, _compiled(written, path), str(path))
    return {f"{path.stem}_calibrated{path.suffix}": written}


def _compiled(data: bytes, path: Path) -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise OutputError(
            "the package mujoco, which reads such files, is not installed",
            remedy="Install it: pip install 'urdfcal[mjcf]'.",
        ) from error
    try:
        specification = mujoco.MjSpec.from_string(data.decode("utf-8-sig"))
        specification.modelfiledir = str(path.absolute().parent)
        return specification.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise RobotError(f"MuJoCo cannot load it: {reason}", where=str(path)) from error


def _check(calibration: Calibration, found: Match, old: Any, new: Any, where: str) -> None:
    """Let MuJoCo move both models and compare with the chain, as drawn and as built."""
    chain = calibration.chain
    q = chain.random_values(_CHECK_POSES, np.random.default_rng(0))
    tips = [tip for tip in chain.tips if tip.joint != BASE]  # what is fixed to the base link no body carries
    joints = [tip.joint for tip in tips]
    at_zero = _bodies_at(old, found, joints, np.zeros((1, len(chain.joints))))[0, 0]
    T_world_base = at_zero @ inverse(found.T_base_body[joints[0]])
    to_tip = np.array([found.T_body_link[tip.joint] @ tip.T_joint_link for tip in tips])[:, None]
    drawn_error, built_error = (
        float(
            np.abs(
                _bodies_at(model, found, joints, q) @ to_tip
                - T_world_base @ np.array(link_poses(chain, q, tips, placements))
            ).max()
        )
        for model, placements in ((old, chain.placements), (new, calibration.placements))
    )
    if not built_error <= _CARRIED * drawn_error + _AGREEMENT:
        raise OutputError(
            f"the new model does not move as the calibrated robot: {built_error:.1e} m or in the rotation",
            where=where,
            remedy="This is a defect of urdfcal: please report it with the file.",
        )


def _bodies_at(model: Any, found: Match, joints: Sequence[int], q: Floats) -> Floats:
    """T_world_body (K, N, 4, 4) of K joints' bodies at joint values (N, n), by MuJoCo."""
    import mujoco

    data = mujoco.MjData(model)
    T = np.tile(np.eye(4), (len(joints), len(q), 1, 1))
    for k, q_k in enumerate(q):
        data.qpos[:] = model.qpos0
        data.qpos[[body.address for body in found.bodies]] = q_k
        mujoco.mj_kinematics(model, data)
        for i, body in enumerate(found.bodies[joint].index for joint in joints):
            T[i, k, :3, :3], T[i, k, :3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    return T
