"""The cameras that a bag describes: their lenses by camera_info, their poses by that or by /tf_static."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Floats, inverse
from urdfcal.cameras.io.ros import CameraInfo, rig_of
from urdfcal.cameras.rig import Rig
from urdfcal.errors import CameraError
from urdfcal.names import listed
from urdfcal.rotations import quaternion_to_matrix
from urdfcal.session.attachments import CameraMount

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.rosbag.bag import Message

TF_STATIC = "/tf_static"

# Keys of a camera_info file, as our messages name them, and the fields of ROS 2; those of ROS 1 are in capitals.
_FIELDS = {"camera_matrix": "k", "distortion_coefficients": "d", "rectification_matrix": "r", "projection_matrix": "p"}
# REP 103: a frame with z forward, x right and y down, as a camera's is here, has this in its name.
_OPTICAL = "optical"
# Two lenses are never a micrometre apart; a placeholder's are. [m]
_LEAST_APART = 1e-6
# tf2 refuses quaternions that are off by more than this.
_UNIT = 1e-2
_ELSEWHERE = "Describe the cameras with --cameras FILE."


@dataclass(frozen=True, eq=False)
class BagCameras:
    """The cameras of a bag.

    Attributes:
        rig: their lenses, and where they stand as far as that is known; the first one is the world.
        notes: a sentence for each pose on where it comes from.
        frames: the name of each one's frame.
        parents: of the frames in /tf_static each one's parent, and T_parent_frame (4, 4). [m]
    """

    rig: Rig
    notes: tuple[str, ...] = ()
    frames: tuple[str, ...] = ()
    parents: Mapping[str, tuple[str, Floats]] = field(default_factory=dict)

    def mounts(self, urdf: Urdf, joints: Collection[str]) -> tuple[tuple[CameraMount, ...], tuple[str, ...]]:
        """Find cameras on moving links: their optical frames are links of the robot, or hang on one by /tf_static.

        Args:
            urdf: the robot.
            joints: names of those that were recorded.

        Returns:
            The eye-in-hand cameras, where they are being a guess to start from, and sentences on them.

        Raises:
            CameraError: the transforms go round in a circle.
        """
        above = {joint.child: joint for joint in urdf.joints.values()}
        mounts, notes = [], []
        # Of cameras that a file describes the bag says no frames.
        for name, frame in zip(self.rig.names, self.frames, strict=bool(self.frames)):
            link, T_link_frame = _root(self.parents, frame, urdf.links)
            if link not in urdf.links or _OPTICAL not in frame:
                continue
            moving, at = [], link
            while at in above:
                moving += [above[at].name] if above[at].type != "fixed" else []
                at = above[at].parent
            if not moving:
                continue
            if unknown := [joint for joint in moving if joint not in joints]:
                notes.append(f"{name} is on {link}, which {listed(unknown)} moves: it is taken to stand still")
                continue
            mounts.append(CameraMount(name, link, T_link_frame))
            notes.append(f"{name} is on {link}, by {'the URDF' if frame == link else TF_STATIC}: where is estimated")
        return tuple(mounts), tuple(notes)

    def without_others(self, mounts: Sequence[CameraMount]) -> Rig:
        """Return the rig, of each camera its place by the first one only where both are fastened to the same thing."""
        links = {mount.camera: mount.link for mount in mounts}
        first, *_ = on = [links.get(name) for name in self.rig.names]
        poses = [T if link == first else None for T, link in zip(self.rig.T_cam_world, on, strict=True)]
        return replace(self.rig, T_cam_world=tuple(poses))


def read_bag_cameras(topics: Sequence[tuple[str, str]], messages: Iterable[Message]) -> BagCameras:
    """Read the cameras; the first one is the world.

    A camera's pose comes from its projection matrix if it is the second of a stereo pair, else from /tf_static if that
    connects the optical frames of both; else it is unknown, and to be estimated.

    Args:
        topics: of every camera its name and the topic of its camera_info.
        messages: of these topics and of /tf_static.

    Raises:
        CameraError: a camera has no camera_info, one that changes, or one that does not describe its images.
    """
    first: dict[str, Any] = {}
    transforms: list[Any] = []
    for message in messages:
        if message.topic == TF_STATIC:
            transforms += message.content.transforms
        elif _values(first.setdefault(message.topic, message.content)) != _values(message.content):
            raise CameraError(
                "it changes during the recording",
                where=message.topic,
                remedy=f"Cut the bag where the lens was changed. {_ELSEWHERE}",
            )
    for _, topic in topics:
        if topic not in first:
            raise CameraError("there is no camera_info", where=topic, remedy=_ELSEWHERE)
    rig = rig_of([_info(name, topic, first[topic]) for name, topic in topics])
    # Of a frame that is given twice, the last. ROS 1 once wrote a slash before names.
    parents = {
        one.child_frame_id.removeprefix("/"): (one.header.frame_id.removeprefix("/"), _rigid(one)) for one in transforms
    }
    frames = [first[topic].header.frame_id.removeprefix("/") for _, topic in topics]
    poses, notes = [rig.T_cam_world[0]], []
    for (name, source), T, frame in zip(topics[1:], rig.T_cam_world[1:], frames[1:], strict=True):
        if T is None and _OPTICAL in frame and _OPTICAL in frames[0]:
            source = TF_STATIC
            (root, T_root_frame), (other_root, T_root_first) = _root(parents, frame), _root(parents, frames[0])
            T_frame_first = inverse(T_root_frame) @ T_root_first
            if root == other_root and np.linalg.norm(T_frame_first[:3, 3]) >= _LEAST_APART:
                T = T_frame_first
        poses.append(T)
        notes.append(f"the pose of {name} is " + (f"from {source}" if T is not None else "not known: it is estimated"))
    return BagCameras(Rig(rig.cameras, tuple(poses)), tuple(notes), tuple(frames), parents)


def _info(name: str, topic: str, message: Any) -> CameraInfo:
    """Convert one message, checked for what a file cannot say."""

    def error(key: str, what: str, remedy: str) -> CameraError:
        return CameraError(what, where=f"{topic} ({_FIELDS.get(key, key)})", remedy=remedy)

    K, D, R, P = (_array(message, field) for field in ("k", "d", "r", "p"))
    for key, values in zip(_FIELDS, (K, D, R, P), strict=True):
        if not np.isfinite(values).all():
            raise error(key, "it has values that are not finite", _ELSEWHERE)
    if not K.any():
        raise error("camera_matrix", "the camera is not calibrated: its matrix is zero", _ELSEWHERE)
    size = (int(message.width), int(message.height))
    # All zero is the whole image, too.
    if _part(message) not in ((0, 0, 0, 0), (0, 0, *size)) or message.binning_x > 1 or message.binning_y > 1:
        raise CameraError("images that are binned or cut out (roi) are not supported", where=topic, remedy=_ELSEWHERE)
    return CameraInfo(
        name=name,
        size=size,
        K=K.reshape(3, 3),
        # Simulated cameras without distortion often name no model.
        distortion_model=message.distortion_model or ("" if D.any() else "plumb_bob"),
        D=D,
        R=R.reshape(3, 3) if R.any() else np.eye(3),
        P=P.reshape(3, 4) if P.any() else np.eye(3, 4),
        where=topic,
        error=error,
    )


def _array(message: Any, field: str) -> Floats:
    values = getattr(message, field) if hasattr(message, field) else getattr(message, field.upper())
    return np.asarray(values, dtype=np.float64)


def _values(message: Any) -> tuple[Any, ...]:
    """All that a camera_info says, to be compared."""
    size = (message.width, message.height, message.binning_x, message.binning_y)
    arrays = tuple(_array(message, field).tobytes() for field in _FIELDS.values())
    return (*size, *_part(message), message.distortion_model, *arrays)


def _part(message: Any) -> tuple[int, int, int, int]:
    roi = message.roi
    return roi.x_offset, roi.y_offset, roi.width, roi.height


def _root(parents: Mapping[str, tuple[str, Floats]], frame: str, stops: Collection[str] = ()) -> tuple[str, Floats]:
    """Return the root of the tree that ``frame`` is in, or the first of ``stops`` above it, and T_root_frame."""
    T, passed = np.eye(4), {frame}
    while frame in parents and frame not in stops:
        frame, T_parent_frame = parents[frame]
        T = T_parent_frame @ T
        if frame in passed:
            raise CameraError(f"the frame {frame!r} is its own ancestor", where=TF_STATIC)
        passed.add(frame)
    return frame, T


def _rigid(transform: Any) -> Floats:
    q, t = transform.transform.rotation, transform.transform.translation
    quaternion = np.array([q.x, q.y, q.z, q.w])
    T = np.eye(4)
    T[:3, 3] = t.x, t.y, t.z
    if not abs(np.linalg.norm(quaternion) - 1.0) < _UNIT or not np.isfinite(T).all():
        raise CameraError(
            f"the transform from {transform.child_frame_id!r} to {transform.header.frame_id!r} is not rigid",
            where=TF_STATIC,
        )
    T[:3, :3] = quaternion_to_matrix(quaternion)
    return T
