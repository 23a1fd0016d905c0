"""The cameras that a bag describes: their lenses by camera_info, and where they stand by that or by /tf_static."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.cameras.io.ros import CameraInfo, rig_of
from urdfcal.cameras.rig import Rig
from urdfcal.errors import CameraError
from urdfcal.rosbag.static_transforms import TF_STATIC, StaticFrames, bare

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.rosbag.bag import Message

# Keys of a camera_info file, as vision.ros names them in messages, and the message's fields: those of ROS 2, and of
# ROS 1 in capitals.
_FIELDS = {"camera_matrix": "k", "distortion_coefficients": "d", "rectification_matrix": "r", "projection_matrix": "p"}
# REP 103: a frame with z forward, x right and y down, as a camera's is here, has this in its name.
_OPTICAL = "optical"
# Two lenses are never a micrometre apart; a placeholder's are. [m]
_LEAST_APART = 1e-6
_ELSEWHERE = "Describe the cameras with --cameras FILE."


def read_rig(topics: Sequence[tuple[str, str]], messages: Iterable[Message]) -> tuple[Rig, tuple[str, ...]]:
    """Read the cameras; the first one is the world.

    Where a camera stands is told by its projection matrix if it is the second of a stereo pair, else by /tf_static if
    that connects the optical frames of both; else it is unknown, and to be estimated.

    Args:
        topics: of every camera its name and the topic of its camera_info.
        messages: of these topics and of /tf_static.

    Returns:
        The cameras, and how their places are known in words.

    Raises:
        CameraError: a camera has no camera_info, one that changes, or one that does not describe its pictures.
    """
    first: dict[str, Any] = {}
    transforms = []
    for message in messages:
        if message.topic == TF_STATIC:
            transforms.append(message.content)
        elif message.topic not in first:
            first[message.topic] = message.content
        elif _all_of(message.content) != _all_of(first[message.topic]):
            raise CameraError(
                "it changes during the recording",
                where=message.topic,
                remedy=f"Cut the bag where the lens was changed. {_ELSEWHERE}",
            )
    for _, topic in topics:
        if topic not in first:
            raise CameraError("there is no camera_info", where=topic, remedy=_ELSEWHERE)
    rig = rig_of([_info(name, topic, first[topic]) for name, topic in topics])
    static = StaticFrames(transforms)
    frames = [bare(first[topic].header.frame_id) for _, topic in topics]
    places, notes = [rig.T_cam_world[0]], []
    for (name, source), T, frame in zip(topics[1:], rig.T_cam_world[1:], frames[1:], strict=True):
        if T is None and _OPTICAL in frame and _OPTICAL in frames[0]:
            T, source = static.between(frame, frames[0]), TF_STATIC
            if T is not None and np.linalg.norm(T[:3, 3]) < _LEAST_APART:
                T = None
        places.append(T)
        notes.append(f"where {name} stands is " + (f"from {source}" if T is not None else "not known: it is estimated"))
    return Rig(rig.cameras, tuple(places)), tuple(notes)


def _info(name: str, topic: str, message: Any) -> CameraInfo:
    """What one message says, checked for what a file cannot say."""

    def error(key: str, what: str, remedy: str) -> CameraError:
        return CameraError(what, where=f"{topic} ({_FIELDS.get(key, key)})", remedy=remedy)

    K, D, R, P = (_array(message, field) for field in ("k", "d", "r", "p"))
    for key, values in zip(_FIELDS, (K, D, R, P), strict=True):
        if not np.isfinite(values).all():
            raise error(key, "it has values that are not finite", _ELSEWHERE)
    if not K.any():
        raise error("camera_matrix", "the camera is not calibrated: its matrix is zero", _ELSEWHERE)
    roi, size = message.roi, (int(message.width), int(message.height))
    # All zero is the whole picture, too.
    cut = (roi.x_offset, roi.y_offset, roi.width, roi.height) not in ((0, 0, 0, 0), (0, 0, *size))
    if cut or message.binning_x > 1 or message.binning_y > 1:
        raise CameraError("pictures that are binned or cut out (roi) are not supported", where=topic, remedy=_ELSEWHERE)
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


def _all_of(message: Any) -> tuple[Any, ...]:
    """All that a camera_info says, to be compared."""
    roi = message.roi
    size = (message.width, message.height, message.binning_x, message.binning_y)
    cut = (roi.x_offset, roi.y_offset, roi.width, roi.height)
    arrays = tuple(_array(message, field).tobytes() for field in _FIELDS.values())
    return (*size, *cut, message.distortion_model, *arrays)
