"""Hand-eye samples of easy_handeye2 and MoveIt: poses of a hand and of what a camera sees, without joints.

The arm that such a session has is a free-floating one of six joints, whose readings are the hand's pose: nothing of it
is estimated, and what comes out is where the camera is, T_world_base, and where the target.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, Field, model_validator

from urdfcal.arrays import inverse
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Poses
from urdfcal.io.keys import OpenKeys
from urdfcal.io.yaml_document import Document
from urdfcal.robot.chain import Chain
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.rotations import matrix_to_quaternion, matrix_to_rpy, quaternion_to_matrix
from urdfcal.session.knowledge import Estimate
from urdfcal.session.model import Session
from urdfcal.session.pattern import FramePattern
from urdfcal.session.target import Target

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.arrays import Floats

Eye = Literal["hand", "base"]

# How far a matrix or a quaternion may be from a rotation: six digits of an angle.
_RIGID = 1e-3
# No arm reaches, and no camera sees a tag, as far as this; in millimetres every sample is farther. [m]
_FARTHEST = 20.0


def _rigid(values: list[float]) -> list[float]:
    if len(values) != 16:
        raise ValueError(f"it has {len(values)} values, not the 16 of a matrix, row by row")
    T = np.array(values).reshape(4, 4)
    turned = np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < _RIGID and np.linalg.det(T[:3, :3]) > 0.0
    if not turned or np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() > _RIGID:
        raise ValueError("it is no pose: its rotation is none, or its last row is not 0 0 0 1")
    return values


_Matrix = Annotated[list[float], AfterValidator(_rigid)]


class _Vector(OpenKeys):
    x: float
    y: float
    z: float


class _Quaternion(_Vector):
    w: float

    @model_validator(mode="after")
    def _unit(self) -> _Quaternion:
        if abs(np.linalg.norm([self.x, self.y, self.z, self.w]) - 1.0) > _RIGID:
            raise ValueError("the quaternion is not of length 1")
        return self


class _Transform(OpenKeys):
    """A geometry_msgs/Transform."""

    translation: _Vector
    rotation: _Quaternion

    @property
    def T(self) -> Floats:
        """The same as a matrix (4, 4)."""
        T, q = np.eye(4), self.rotation
        T[:3, :3] = quaternion_to_matrix([q.x, q.y, q.z, q.w])
        T[:3, 3] = self.translation.x, self.translation.y, self.translation.z
        return T


class _EasySample(OpenKeys):
    """Of easy_handeye2: of a camera at the base, ``robot`` is where the base is in the hand."""

    robot: _Transform
    tracking: _Transform


class _MoveitSample(OpenKeys):
    """Of MoveIt: the hand in the base, and the target in the camera, matrices row by row."""

    effector_wrt_world: _Matrix
    object_wrt_sensor: _Matrix


class _Parameters(OpenKeys):
    calibration_type: str = ""
    robot_base_frame: str = ""
    robot_effector_frame: str = ""
    tracking_marker_frame: str = ""


class _EasyFile(OpenKeys):
    parameters: _Parameters = Field(default=_Parameters())


# What easy_handeye and easy_handeye2 call the two.
_TYPES: dict[str, Eye] = {"eye_in_hand": "hand", "eye_on_hand": "hand", "eye_on_base": "base", "eye_to_hand": "base"}


@dataclass(frozen=True, eq=False)
class HandEyeSamples:
    """Poses of a hand, and of a target in a camera that sees it.

    Attributes:
        eye: what carries the camera; the target is on the other.
        T_eye_other: (N, 4, 4) hand in base or base in hand: that of the two without the camera in that with it. [m]
        T_cam_target: (N, 4, 4) what the camera saw. [m]
        base: what the robot's base is called.
        hand: what its hand is called.
        target: what the target is called.
    """

    eye: Eye
    T_eye_other: Floats
    T_cam_target: Floats
    base: str
    hand: str
    target: str


def read_handeye(path: Path, eye: Eye | None = None) -> HandEyeSamples:
    """Read a file of samples.

    Args:
        path: what easy_handeye2 saves as .samples, or MoveIt as .yaml.
        eye: what carries the camera; None where the file says it.

    Raises:
        SessionError: it is neither, a sample is no pair of poses in metres, or what carries the camera is not known.
    """
    document = Document.read(path)
    moveit = isinstance(document.data, list)
    node = document.node if moveit else _samples(document)
    if not isinstance(node, yaml.SequenceNode):
        raise _neither(str(path))
    data = document.data if moveit else document.data["samples"]
    parts = [Document(document.source, one, item) for one, item in zip(node.value, data, strict=True)]
    names = _Parameters() if moveit else document.validate(_EasyFile).parameters
    if moveit:
        matrices = [part.validate(_MoveitSample) for part in parts]
        both = [[of.effector_wrt_world, of.object_wrt_sensor] for of in matrices]
    else:
        pairs = [part.validate(_EasySample) for part in parts]
        both = [[of.robot.T.ravel().tolist(), of.tracking.T.ravel().tolist()] for of in pairs]
    robot, seen = np.array(both).reshape(-1, 2, 4, 4).swapaxes(0, 1)
    keys = ("effector_wrt_world", "object_wrt_sensor") if moveit else ("robot", "tracking")
    for key, T in zip(keys, (robot, seen), strict=True):
        _check_metres(parts, key, T)
    told = _TYPES.get(names.calibration_type)
    if eye is not None and told is not None and eye != told:
        remedy = f"Leave --eye out, or write --eye {told}."
        raise SessionError(
            f"the file says that its camera is on the {told}, not the {eye}", where=str(path), remedy=remedy
        )
    eye = eye or told
    if eye is None:
        remedy = "Say what carries the camera: --eye hand or --eye base."
        raise SessionError("the file does not say where the camera was", where=str(path), remedy=remedy)
    # MoveIt writes the hand in the base whatever carries the camera.
    T_eye_other = robot if moveit and eye == "base" else inverse(robot)
    base, hand = names.robot_base_frame or "base", names.robot_effector_frame or "hand"
    return HandEyeSamples(eye, T_eye_other, seen, base, hand, names.tracking_marker_frame or "target")


def _check_metres(parts: list[Document], key: str, T: Floats) -> None:
    """Refuse positions that are too far away to be in metres.

    Args:
        parts: the samples.
        key: of the pose in each.
        T: (N, 4, 4) the poses.

    Raises:
        SessionError: naming the first sample.
    """
    away = np.linalg.norm(T[:, :3, 3], axis=1)
    if not (far := np.flatnonzero(away > _FARTHEST)).size:
        return
    first = int(far[0])
    position = ", ".join(f"{value:.4g}" for value in T[first, :3, 3])
    what = f"the position of sample {first + 1}, [{position}], is {away[first]:.4g} m away"
    many = f", and so far are {far.size - 1} more" if far.size > 1 else ""
    remedy = "Write positions in metres; if they are in millimetres, divide them by 1000."
    raise SessionError(f"{what}{many}", where=parts[first].place(key), remedy=remedy)


def handeye_session(samples: HandEyeSamples) -> Session:
    """Make a session of them: the camera's frame is the world, the free-floating arm stands on what carries the camera.

    Raises:
        SessionError: there are too few.
    """
    root, tip = (samples.hand, samples.base) if samples.eye == "hand" else (samples.base, samples.hand)
    if root == tip:
        raise SessionError(f"base and hand are both called {root!r}", where="parameters", remedy="Rename one of them.")
    T = samples.T_eye_other
    urdf = Urdf.parse(_free_floating(root, tip, float(np.abs(T[:, :3, 3]).max(initial=0.0))).encode())
    rpy = np.array([matrix_to_rpy(of[:3, :3]) for of in T]).reshape(-1, 3)
    places = np.column_stack(
        [samples.T_cam_target[:, :3, 3], [matrix_to_quaternion(of[:3, :3]) for of in samples.T_cam_target]]
    )
    each = np.arange(len(T))
    poses = Poses(each, each * 0, places, *(np.array(of.usual) for of in Poses.spreads.values()))
    chain = Chain.from_urdf(urdf, tip)
    return Session(
        chain=chain,
        urdf=urdf,
        urdf_reference="free_floating.urdf",
        targets=(Target(samples.target, FramePattern(), tip),),
        poses=tuple(str(k + 1) for k in each),
        q=np.column_stack([T[:, :3, 3], rpy[:, ::-1]]),
        estimate=Estimate(geometry="none"),
        measurements=(poses,),
    )


def _samples(document: Document) -> yaml.Node | None:
    """The samples of easy_handeye2's file, as composed."""
    if not isinstance(document.data, dict) or not isinstance(document.data.get("samples"), list):
        return None
    pairs: list[tuple[yaml.Node, yaml.Node]] = document.node.value
    return next(value for key, value in pairs if key.value == "samples")


def _neither(where: str) -> SessionError:
    remedy = (
        "easy_handeye2 saves samples: [{robot: ..., tracking: ...}, ...], "
        "MoveIt [{effector_wrt_world: [...], object_wrt_sensor: [...]}, ...]."
    )
    return SessionError("these are no hand-eye samples", where=where, remedy=remedy)


def _free_floating(root: str, tip: str, reach: float) -> str:
    """A URDF whose six joints take ``tip`` as far as ``reach`` [m]: along x, y, z, then about z, y, x."""
    from xml.sax.saxutils import quoteattr

    joints = [("x", "prismatic", "1 0 0"), ("y", "prismatic", "0 1 0"), ("z", "prismatic", "0 0 1")]
    joints += [("yaw", "continuous", "0 0 1"), ("pitch", "continuous", "0 1 0"), ("roll", "continuous", "1 0 0")]
    links = [root, *(f"{root}_{name}" for name, *_ in joints[:-1]), tip]
    # The limits are of no use but as a check of units: a hand within them, and no arm of a hundred metres.
    far = float(np.ceil(reach) + 1.0)
    lines = ['<?xml version="1.0"?>', '<robot name="free_floating">']
    lines += [f"  <link name={quoteattr(link)}/>" for link in links]
    for (name, kind, axis), parent, child in zip(joints, links, links[1:], strict=False):
        limit = f'<limit lower="{-far}" upper="{far}" effort="1" velocity="1"/>' if kind == "prismatic" else ""
        lines.append(
            f'  <joint name="{name}" type="{kind}"><parent link={quoteattr(parent)}/><child link={quoteattr(child)}/>'
            f'<axis xyz="{axis}"/>{limit}</joint>'
        )
    return "\n".join([*lines, "</robot>", ""])
