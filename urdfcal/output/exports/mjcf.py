"""MuJoCo: the calibrated placements in an existing model of the same robot.

A MuJoCo file may put its bodies' frames elsewhere than a URDF its links', fuse what fixed joints hold, and count a
joint from another zero (``ref``). Two robots move alike if with all joints at zero their axes are the same lines. With
Z_i joint i's body in its parent body with all joints at zero, as MuJoCo computes it, S_i the place that the file gives
it, C_i the URDF link's frame in the body's, and D_i and B_i the joint's nominal and calibrated placement, the new place
is

    S_i' = Z_i C_i (D_i^-1 B_i) C_i^-1 Z_i^-1 S_i.

The text is edited because ``MjSpec.to_xml`` loses comments and layout, and rounds to six digits: first the ``<body>``
that each joint moves is found, in the end such bodies get new places.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, Ints, inverse
from urdfcal.errors import OutputError, RobotError
from urdfcal.names import suggest
from urdfcal.output.placing import joint_frames
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.mechanism import BASE, Mechanism
from urdfcal.robot.urdf.markup import (
    Edit,
    Element,
    ElementReader,
    apply_edits,
    changed_attributes,
    numbers_text,
    start_tag,
)

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.urdf.urdf import Urdf

# MuJoCo's kinematics and ours round differently. [m, entries of the rotation]
_AGREEMENT = 1e-9
# What a file of rounded numbers is off before, it may be off after, and a little more for other directions.
_CARRIED = 2.0
# The same robot through different roundings: MuJoCo writes six digits, which sum to some 1e-5 over seven joints.
# [m, entries of a direction]
_SAME = 5e-5
_CHECK_POSES = 20
# MuJoCo's other ways to write a body's orientation; quat takes their place.
_OTHER_ORIENTATIONS = ("axisangle", "xyaxes", "zaxis", "euler")


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
    elements, model = joint_bodies(data, str(path)), compiled(data, path)
    chain, placements = calibration.chain, calibration.placements
    joints = _joints(model, chain, str(path))
    bodies, zero = model.jnt_bodyid[joints], np.zeros((1, len(joints)))
    for name in (name for name in chain.names if name not in elements):
        raise RobotError(
            f"joint {name!r} is not written out in this file",
            where=str(path),
            remedy="Write its body without <replicate> or <attach>.",
        )
    T_world_base = _base(model, joints, calibration, urdf, str(path))
    links = T_world_base @ joint_frames(chain, chain.placements, zero)[0, 1:]
    T_world, _ = _moved(model, joints, zero)
    edited = []
    for i, body in enumerate(bodies):
        if np.array_equal(chain.placements[i], placements[i]):
            continue
        # Where the body is in its parent body before its joint moves it, and with all joints at zero.
        w, x, y, z = model.body_quat[body]
        place: Floats = pin.SE3(pin.Quaternion(w, x, y, z), model.body_pos[body]).homogeneous
        Z = inverse(T_world[0, model.body_parentid[body]]) @ T_world[0, body]
        to_link = Z @ inverse(T_world[0, body]) @ links[i]
        new = to_link @ inverse(chain.placements[i]) @ placements[i] @ inverse(to_link) @ place
        edited.append((elements[chain.names[i]], place, new))
    written = with_places(data, edited)
    # MuJoCo moves both models, to be compared with the nominal and the calibrated chain.
    q = chain.random_values(_CHECK_POSES, np.random.default_rng(0))
    tips = [tip for tip in chain.tips if tip.joint != BASE]  # what is fixed to the base link no body carries
    carriers = bodies[[tip.joint for tip in tips]]
    to_tip = inverse(T_world[0, carriers]) @ T_world_base @ np.array(link_poses(chain, zero, tips))[:, 0]

    def deviation(moving: Any, placed: Floats) -> float:
        expected = T_world_base @ np.stack(link_poses(chain, q, tips, placed), axis=1)
        return float(np.abs(_moved(moving, joints, q)[0][:, carriers] @ to_tip - expected).max())

    before, after = deviation(model, chain.placements), deviation(compiled(written, path), placements)
    if not after <= _CARRIED * before + _AGREEMENT:
        raise OutputError(
            f"the new model does not move as the calibrated robot: {after:.1e} m or in the rotation",
            where=str(path),
            remedy="This is a defect of urdfcal: please report it with the file.",
        )
    return {f"{path.stem}_calibrated{path.suffix}": written}


def compiled(data: bytes, path: Path) -> Any:
    """Have MuJoCo read a file that finds its meshes where ``path`` is.

    Raises:
        OutputError: the package mujoco is missing.
        RobotError: it cannot be read.
    """
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


def _joints(model: Any, chain: Mechanism, where: str) -> Ints:
    """Find the indices of the robot's joints by name.

    Raises:
        RobotError: one is missing or of another type, or bodies hang in another order.
    """
    import mujoco

    kinds = {mujoco.mjtJoint.mjJNT_HINGE: False, mujoco.mjtJoint.mjJNT_SLIDE: True}
    names = [model.joint(i).name for i in range(model.njnt)]
    index: list[int] = []
    bodies: list[int] = []
    for joint, parent in zip(chain.joints, chain.parents, strict=True):
        if joint.name not in names:
            raise RobotError(
                f"there is no joint {joint.name!r}", where=where, remedy=suggest(joint.name, names, "joints")
            )
        index.append(names.index(joint.name))
        if kinds.get(mujoco.mjtJoint(int(model.jnt_type[index[-1]]))) is not joint.prismatic:
            raise RobotError(f"joint {joint.name!r} is not a {joint.type} joint", where=where)
        bodies.append(int(model.jnt_bodyid[index[-1]]))
        if model.body_jntnum[bodies[-1]] != 1:
            raise RobotError(
                f"the body of joint {joint.name!r} has {model.body_jntnum[bodies[-1]]} joints",
                where=where,
                remedy="Give each joint a body of its own.",
            )
        carrier = _above(model, bodies[-1])[-1]
        if carrier != (_above(model, bodies[0])[-1] if parent == BASE else bodies[parent]):
            raise RobotError(
                f"joint {joint.name!r} does not hang where it did when it was calibrated",
                where=where,
                remedy="Give a model of the same robot.",
            )
    return np.array(index)


def _above(model: Any, body: int) -> list[int]:
    """Parent body, its parent and so on to one that a joint moves, or the world."""
    above = [int(model.body_parentid[body])]
    while above[-1] != 0 and model.body_jntnum[above[-1]] == 0:
        above.append(int(model.body_parentid[above[-1]]))
    return above


def _moved(model: Any, joints: Ints, q: Floats) -> tuple[Floats, Any]:
    """T_world_body (N, bodies, 4, 4) at joint values (N, n), and MuJoCo's data at the last of them."""
    import mujoco

    data = mujoco.MjData(model)
    T = np.tile(np.eye(4), (len(q), model.nbody, 1, 1))
    for k, q_k in enumerate(q):
        data.qpos[:] = model.qpos0
        data.qpos[model.jnt_qposadr[joints]] = q_k
        mujoco.mj_kinematics(model, data)
        T[k, :, :3, :3], T[k, :, :3, 3] = data.xmat.reshape(-1, 3, 3), data.xpos
    return T, data


def _base(model: Any, joints: Ints, calibration: Calibration, urdf: Urdf, where: str) -> Floats:
    """Find T_world_base (4, 4) by which the model's axes are those of the nominal robot.

    The base link's frame is that of a body above the first joint, or of the world; or such a body's is that of another
    link that is fixed to the base link.

    Raises:
        RobotError: axes are elsewhere.
    """
    chain, zero = calibration.chain, np.zeros((1, len(joints)))
    T_world, data = _moved(model, joints, zero)
    lines = data.xanchor[joints], data.xaxis[joints]
    nominal, already = (joint_frames(chain, of, zero)[0, 1:] for of in (chain.placements, calibration.placements))
    fixed = _fixed_to(urdf, chain.base_link)
    pairs = [(body, link) for body in _above(model, model.jnt_bodyid[joints[0]]) for link in fixed]
    misfits = []
    for body, link in sorted(
        pairs, key=lambda pair: model.body(pair[0]).name != pair[1]
    ):  # bodies named as links first
        T_world_base: Floats = T_world[0, body] @ inverse(fixed[link])
        misfit = _misfit(*lines, chain, T_world_base @ nominal)
        if misfit is None:
            return T_world_base
        if _misfit(*lines, chain, T_world_base @ already) is None:
            raise RobotError(
                "its joints are placed as calibrated already",
                where=where,
                remedy="Give the nominal model: a calibration is applied once.",
            )
        misfits.append(misfit)
    # Of several base frames, the one that explains most joints is the one that was meant.
    index, distance, angle = max(misfits)
    raise RobotError(
        f"the axis of joint {chain.names[index]!r} is not where it was when the robot was calibrated: "
        f"it is {1e3 * distance:.3g} mm and {1e3 * angle:.3g} mrad off",
        where=where,
        remedy="Give a model of the same nominal robot, its base body's frame that of the base link.",
    )


def _fixed_to(urdf: Urdf, base_link: str) -> dict[str, Floats]:
    """T_base_link of every link that no joint moves against the base link, itself first."""
    fixed = [
        (joint.parent, joint.child, joint.T_parent_joint) for joint in urdf.joints.values() if joint.type == "fixed"
    ]
    neighbours = [edge for a, b, T in fixed for edge in ((a, b, T), (b, a, inverse(T)))]
    found = {base_link: np.eye(4)}
    for link in (going := [base_link]):  # grows while it is walked
        for near, far, T in neighbours:
            if near == link and far not in found:
                found[far] = found[link] @ T
                going.append(far)
    return found


def _misfit(anchors: Floats, axes: Floats, chain: Mechanism, links: Floats) -> tuple[int, float, float] | None:
    """The first joint whose axis is another line than the link's: its index, distance [m] and angle [rad]."""
    for i, (joint, T) in enumerate(zip(chain.joints, links, strict=True)):
        axis, between = T[:3, :3] @ joint.axis, T[:3, 3] - anchors[i]
        distance = 0.0 if joint.prismatic else float(np.linalg.norm(np.cross(between, axis)))
        angle = float(np.arctan2(np.linalg.norm(np.cross(axis, axes[i])), axis @ axes[i]))
        if max(distance, angle) > _SAME:
            return i, distance, angle
    return None


def joint_bodies(data: bytes, path: str) -> dict[str, Element]:
    """Find the ``<body>`` that each named joint of a MuJoCo file moves.

    Args:
        data: the file's bytes.
        path: what to call it in messages.

    Raises:
        RobotError: it is no MuJoCo file, or one whose text does not say where its bodies are.
    """
    reader = _MjcfReader(path)
    reader.read(data)
    return reader.bodies


class _MjcfReader(ElementReader):
    """Gathers the body of every named joint."""

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.bodies: dict[str, Element] = {}

    def doctype(self, name: str, system_id: str | None, public_id: str | None, internal_subset: int) -> None:
        raise self.refusal(f"it has a document type, <!DOCTYPE {name} ...>", "Remove it: MuJoCo reads none.")

    def started(self, element: Element) -> None:
        tag, attributes = element.tag, element.attributes
        if not self.opened and tag != "mujoco":
            raise self.refusal(
                f"the root element is <{tag}>, not <mujoco>",
                "For another URDF: urdfcal apply OUT OTHER.urdf." if tag == "robot" else "Is it a MuJoCo file?",
            )
        if tag == "include":
            raise self.refusal(
                "it includes another file, in which bodies may be", "Name the file that holds the robot's bodies."
            )
        if tag == "compiler" and attributes.get("fusestatic") == "true":
            raise self.refusal(
                "fusestatic merges bodies, so that places are not those in the file", 'Write fusestatic="false".'
            )
        if tag == "joint" and "name" in attributes:
            self._joint(attributes["name"])

    def _joint(self, name: str) -> None:
        bodies = [i for i, element in enumerate(self.opened) if element.tag == "body"]
        if not bodies or self.opened[1].tag != "worldbody":
            return  # of an equality, a tendon, a default
        above = self.opened[bodies[-1] - 1].tag
        if above not in ("body", "worldbody"):
            raise self.refusal(
                f"the body of joint {name!r} is inside <{above}>", "Write it directly in the body that carries it."
            )
        self.bodies[name] = self.opened[bodies[-1]]


def with_places(data: bytes, moved: Iterable[tuple[Element, Floats, Floats]]) -> bytes:
    """Give bodies other places; only their ``pos`` and orientation change, and only where they differ.

    Args:
        data: the file's bytes.
        moved: bodies, each with its place (4, 4) in its parent body's frame, as MuJoCo reads it, and the new one. [m]
    """
    edits: list[Edit] = []
    for body, old, new in moved:
        values = {}
        if not np.array_equal(old[:3, 3], new[:3, 3]):
            values["pos"] = numbers_text(new[:3, 3])
        if not np.array_equal(old[:3, :3], new[:3, :3]):
            x, y, z, w = pin.Quaternion(np.ascontiguousarray(new[:3, :3])).normalized().coeffs()
            values["quat"] = numbers_text(np.array([w, x, y, z]))
        written = next((name for name in _OTHER_ORIENTATIONS if name in body.attributes), None)
        if written is not None and "quat" in values:
            attribute = start_tag(data, body).attributes[written]
            quote = attribute["quote"]
            edits.append(Edit(attribute.start("name"), attribute.end(), b"quat=" + quote + values.pop("quat") + quote))
        edits += changed_attributes(data, body, values)
    return apply_edits(data, edits)
