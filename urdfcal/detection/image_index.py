"""Which image shows which LED, or the targets, at which pose: the names of the files in a session's images folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from urdfcal.errors import SessionError
from urdfcal.images.files import SUFFIXES, VIDEO_SUFFIXES, ImageFile, Video
from urdfcal.names import listed, suggest
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from urdfcal.session.model import Positions

_DARK = "off"
# Stands for an LED in the image of a pose that shows the targets.
_PICTURE = -2


class Shot(NamedTuple):
    """An image of one LED at one pose.

    Attributes:
        pose: index of the pose.
        led: index of the LED that is lit.
    """

    pose: int
    led: int


@dataclass(frozen=True)
class ImageIndex:
    """All images of a session.

    Attributes:
        shots: of each camera, by pose and LED.
        images: of each camera, one a shot.
        pictures: of each camera, the poses of which it has a picture of the targets.
        picture_files: of each camera, one a picture.
        warnings: files and cameras that are left over.
    """

    shots: tuple[tuple[Shot, ...], ...]
    images: tuple[tuple[ImageFile, ...] | Video, ...]
    pictures: tuple[tuple[int, ...], ...]
    picture_files: tuple[tuple[ImageFile, ...] | Video, ...]
    warnings: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of images to look for an LED or for targets in."""
        return sum(map(len, (*self.shots, *self.pictures)))


def read_index(folder: Path, positions: Positions) -> ImageIndex:
    """Sort the files of ``folder``/<camera>/: <pose>.png, <pose>.<led>.png or <pose>.off.png (dark, subtracted).

    Where there are targets, <pose>.png shows them, and an LED's image has its name. Of an arm that moved a pose is a
    frame, and ``folder``/<camera>.mp4 may hold all frames of a camera in their order.

    Args:
        folder: of the images.
        positions: whose poses, LEDs and cameras the names refer to.

    Raises:
        SessionError: there is no image, two files say the same, a name does not say which LED is lit, or there is a
            video of an arm that stood still or with several LEDs.
    """
    cameras = positions.rig.names
    if not folder.is_dir():
        remedy = f"Put the images into {folder.name}/<camera>/<pose>.png."
        raise SessionError("there is no such folder", where=str(folder), remedy=remedy)
    if _DARK in positions.led_names:
        what = f"an LED is named {_DARK!r}, as are the images with the LED dark"
        raise SessionError(what, where="leds", remedy="Rename it.")
    warnings = [
        f"{path}: no camera is called {path.name!r}. {suggest(path.name, cameras, 'cameras')}"
        for path in sorted(folder.iterdir())
        if path.is_dir() and path.name not in cameras
    ]
    videos = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()]
    warnings += [f"{path}: no camera is called {path.stem!r}" for path in videos if path.stem not in cameras]
    shots: list[tuple[Shot, ...]] = []
    images: list[tuple[ImageFile, ...] | Video] = []
    pictures: list[tuple[int, ...]] = []
    picture_files: list[tuple[ImageFile, ...] | Video] = []
    for c, camera in enumerate(cameras):
        if mine := [path for path in videos if path.stem == camera]:
            found, video = _frames(mine, c, folder / camera, positions)
            shots.append(found if positions.leds else ())
            images.append(video if positions.leds else ())
            pictures.append(() if positions.leds else tuple(shot.pose for shot in found))
            picture_files.append(() if positions.leds else video)
            continue
        stills, shown, strangers = _sort(folder / camera, c, positions)
        shots.append(tuple(stills))
        images.append(tuple(stills.values()))
        pictures.append(tuple(shown))
        picture_files.append(tuple(shown.values()))
        if not stills and not shown:
            warnings.append(f"{folder / camera}: there are no images of this camera")
        elif strangers:
            warnings.append(f"{folder / camera}: {len(strangers)} files belong to no pose: {listed(strangers)}")
    index = ImageIndex(tuple(shots), tuple(images), tuple(pictures), tuple(picture_files), tuple(warnings))
    if not index.count:
        raise SessionError(
            "there is no image of any pose and camera",
            where=str(folder),
            remedy=f"They are to be called <camera>/<pose>{SUFFIXES[0]}; {listed(cameras)} are the cameras, "
            f"{listed(positions.poses[:3])} the first poses.",
        )
    return index


def _frames(paths: Sequence[Path], camera: int, folder: Path, positions: Positions) -> tuple[tuple[Shot, ...], Video]:
    """The shots in a camera's video: its n-th image is the n-th of the camera's frames."""
    path, *others = paths
    if others or folder.is_dir():
        other = others[0] if others else folder
        remedy = "One video, or one folder, a camera: keep one."
        raise SessionError(f"there is {other.name} as well", where=str(path), remedy=remedy)
    if not isinstance(positions.motion, Trajectory):
        remedy = "frames: frames.csv in session.yaml lists them: camera,frame,time."
        raise SessionError("this is a video, and the session names no frames", where=str(path), remedy=remedy)
    if len(positions.leds) + len(positions.targets) > 1 and positions.leds:
        count = len(positions.leds) + len(positions.targets)
        what = f"there are {count} LEDs and targets, and a video does not say which is lit"
        remedy = "Write its frames as images <frame>.<led>.png, or leave one LED on."
        raise SessionError(what, where=str(path), remedy=remedy)
    poses = _poses_of(positions.motion, camera)
    rows = tuple(int(positions.motion.row[pose]) for pose in poses.values())
    shots = tuple(Shot(pose, 0) for pose in poses.values())
    return shots, Video(path, rows, len(positions.motion.frames[camera]))


def _poses_of(trajectory: Trajectory, camera: int) -> dict[str, int]:
    """The pose by frame label, of the frames of one camera that are used, in order."""
    mine = sorted((k for k, c in enumerate(trajectory.camera) if c == camera), key=lambda k: int(trajectory.row[k]))
    return {trajectory.label(k): k for k in mine}


def _sort(
    folder: Path, camera: int, positions: Positions
) -> tuple[dict[Shot, ImageFile], dict[int, ImageFile], list[str]]:
    """The shots in one camera's folder, its pictures of targets, and the names of image files that say nothing."""
    if not isinstance(positions.motion, Trajectory):
        poses = {name: i for i, name in enumerate(positions.poses)}
        known = set(poses)
    else:
        poses, known = _poses_of(positions.motion, camera), set(positions.motion.frames[camera])
    leds = [led.name for led in positions.leds]
    numbers = {"": 0, _DARK: -1} | {name: i for i, name in enumerate(leds)}
    found: dict[Shot, Path] = {}
    strangers = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.suffix.lower() not in SUFFIXES:
            continue
        # A pose's label may hold dots itself: the whole name first.
        label, _, last = (path.stem, "", "") if path.stem in known else path.stem.rpartition(".")
        pose = poses.get(label)
        if pose is None and label in known:
            continue  # a frame that is not used, as the session's warnings say
        if pose is None or last not in numbers:
            strangers.append(path.name)
            continue
        if not last and not positions.targets and len(leds) > 1:
            what = f"there are {len(leds)} LEDs, and the name does not say which is lit"
            remedy = f"Call it {path.stem}.{leds[0]}{path.suffix} or the like, one image an LED."
            raise SessionError(what, where=str(path), remedy=remedy)
        number = numbers[last] if last or not positions.targets else _PICTURE
        if (other := found.setdefault(Shot(pose, number), path)) is not path:
            raise SessionError(f"this is the same image as {other.name}", where=str(path), remedy="Keep one.")
    lit = [(shot, path) for shot, path in sorted(found.items()) if shot.led >= 0]
    shown = {shot.pose: ImageFile(path) for shot, path in sorted(found.items()) if shot.led == _PICTURE}
    return {shot: ImageFile(path, found.get(Shot(shot.pose, -1))) for shot, path in lit}, shown, strangers
