"""The choice of a bag's topics: joints and cameras by their types and ROS's names, or as the user says."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from urdfcal.errors import SessionError
from urdfcal.names import listed, suggest
from urdfcal.rosbag.bag import CAMERA_INFO, COMPRESSED, IMAGE, JOINT_STATE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.rosbag.bag import Topic

_IMAGES = (IMAGE, COMPRESSED)
# A camera's name becomes a folder's.
_FOLDER = re.compile(r"\w[\w .-]*")


@dataclass(frozen=True)
class ChosenTopics:
    """The topics that a session is made of.

    Attributes:
        joints: the joint states.
        cameras: by the camera's name in the session its images and its camera_info, None where it is described
            elsewhere; one or more.
    """

    joints: str
    cameras: Mapping[str, tuple[str, str | None]]

    @property
    def names(self) -> tuple[str, ...]:
        """All topics."""
        return (self.joints, *(name for of in self.cameras.values() for name in of if name))


def choose_topics(
    topics: Sequence[Topic],
    joints: str | None = None,
    cameras: Mapping[str, tuple[str, str | None]] | None = None,
    *,
    infos: bool = True,
) -> ChosenTopics:
    """Find the topics of the joints and the cameras.

    Args:
        topics: all of the bag.
        joints: the topic with the joint states; None: the only one.
        cameras: topics of the images, and of the camera_info if it has an unusual name, by camera; empty: all.
        infos: whether the bag is to describe the cameras.

    Raises:
        SessionError: a topic is missing or of another type, or the choice between several is open.
    """
    filled = [topic for topic in topics if topic.count]
    named = cameras or _by_namespace(filled)
    chosen = {name: (image, _info(filled, name, image, info, infos=infos)) for name, (image, info) in named.items()}
    for name, (image, _) in chosen.items():
        if not _FOLDER.fullmatch(name):
            raise SessionError(
                f"the camera's name {name!r} cannot be that of a folder",
                remedy=f"Use letters and digits: --camera NAME={image}.",
            )
    if len({image for image, _ in chosen.values()}) < len(chosen):
        raise SessionError("two cameras have the same images", remedy="Every camera has a topic of its own.")
    return ChosenTopics(_joints(filled, joints), chosen)


def _joints(topics: Sequence[Topic], named: str | None) -> str:
    if named is not None:
        return _known(topics, named, (JOINT_STATE,))
    found = [topic.name for topic in topics if topic.type == JOINT_STATE]
    if not found:
        raise _none_of("joint states (sensor_msgs/JointState)", topics)
    if len(found) > 1:
        raise SessionError(
            f"there are {len(found)} topics with joint states: {listed(found)}", remedy=f"Use --joints {found[0]}."
        )
    return found[0]


def _info(topics: Sequence[Topic], name: str, image: str, info: str | None, *, infos: bool) -> str | None:
    """Return the topic of a camera's camera_info, if the bag is to describe it."""
    _known(topics, image, _IMAGES)
    usual = f"{_namespace(image)}/camera_info"  # where image_transport looks for it
    if info is not None:
        _known(topics, info, (CAMERA_INFO,))
    elif not infos:
        return None
    there = [topic.name for topic in topics if topic.type == CAMERA_INFO]
    if info is None and usual not in there:
        raise SessionError(
            f"{image} has no {usual}",
            remedy="Describe the cameras with --cameras FILE"
            + (f", or name one of {listed(there)}: --camera {name}={image},{there[0]}." if there else "."),
        )
    info = info or usual
    if info == usual and image.rpartition("/")[2].startswith("image_rect"):
        raise SessionError(
            f"{image} is rectified, {usual} describes the images before that",
            remedy="Use the raw images, or describe the rectified ones with --cameras FILE.",
        )
    return info


def _by_namespace(topics: Sequence[Topic]) -> dict[str, tuple[str, None]]:
    """Return the topic of the images of every camera, if each has only one."""
    by_space: dict[str, list[str]] = {}
    for topic in topics:
        if topic.type in _IMAGES:
            by_space.setdefault(_namespace(topic.name), []).append(topic.name)
    if not by_space:
        raise _none_of("images (sensor_msgs/Image or CompressedImage)", topics)
    spaces = sorted(by_space, key=_natural)
    for space in spaces:
        if len(by_space[space]) > 1:
            every = [name for one in spaces for name in by_space[one]]
            raise SessionError(
                f"there are {len(by_space[space])} topics with images in {space or '/'}",
                remedy=f"Say which to use, --camera NAME=TOPIC for each camera. The topics are: {listed(every)}.",
            )
    # A camera of the root namespace has none to be called by.
    names = [space.rpartition("/")[2] or "camera" for space in spaces]
    if len(set(names)) < len(names):
        names = [space.strip("/").replace("/", "_") or "camera" for space in spaces]
    if len(set(names)) < len(names):
        raise SessionError(
            f"the cameras in {listed([space or '/' for space in spaces])} cannot be named after their namespaces",
            remedy="Name them: --camera NAME=TOPIC for each.",
        )
    return {name: (by_space[space][0], None) for name, space in zip(names, spaces, strict=True)}


def _namespace(image: str) -> str:
    """Return the namespace of a camera's topics: /left of /left/image_raw and of /left/image_raw/compressed."""
    return image.removesuffix("/compressed").rpartition("/")[0]


def _natural(name: str) -> list[tuple[bool, int, str]]:
    """Return a key that sorts cam2 before cam10."""
    parts = re.split(r"(\d+)", name)
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in parts]


def _known(topics: Sequence[Topic], name: str, types: Sequence[str]) -> str:
    """Return ``name`` if there is such a topic, and of one of these types."""
    usable = [topic.name for topic in topics if topic.type in types]
    if name not in usable:
        found = next((topic.type for topic in topics if topic.name == name), None)
        kinds = " or ".join(type_.rpartition("/")[2] for type_ in types)
        raise SessionError(
            f"there is no topic {name!r}" if found is None else f"the topic {name!r} is {found}, not {kinds}",
            remedy=suggest(name, usable, f"topics with {kinds}") if usable else f"No topic has {kinds}.",
        )
    return name


def _none_of(what: str, topics: Sequence[Topic]) -> SessionError:
    names = [f"{topic.name} ({topic.type})" for topic in topics]
    return SessionError(f"there are no {what}", remedy=f"The topics are: {listed(names)}.")
