"""Which picture shows which LED at which pose: the names of the files in a session's images folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from urdfcal.errors import SessionError
from urdfcal.session.names import listed, suggest
from urdfcal.vision.images import SUFFIXES
from urdfcal.vision.led import Picture

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from urdfcal.session.model import Positions

_DARK = "off"

_K = TypeVar("_K")


@dataclass(frozen=True)
class Shot:
    """A picture of one LED at one pose.

    Attributes:
        pose: index of the pose.
        led: index of the LED that is lit.
        picture: the files.
    """

    pose: int
    led: int
    picture: Picture


@dataclass(frozen=True)
class Album:
    """All pictures of a session.

    Attributes:
        shots: of each camera, by pose and LED.
        warnings: files and cameras that are left over.
    """

    shots: tuple[tuple[Shot, ...], ...]
    warnings: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of pictures to look for an LED in."""
        return sum(map(len, self.shots))


def read_album(folder: Path, positions: Positions) -> Album:
    """Sort the files of ``folder``/<camera>/: <pose>.png, <pose>.<led>.png or <pose>.off.png (dark, subtracted).

    Args:
        folder: of the images.
        positions: whose poses, LEDs and cameras the names refer to.

    Raises:
        SessionError: there is no picture, two files say the same, or a name does not say which LED is lit.
    """
    cameras = positions.rig.names if positions.rig is not None else ()
    if not folder.is_dir():
        raise SessionError(
            "there is no such folder",
            where=str(folder),
            remedy=f"Put the pictures into {folder.name}/<camera>/<pose>.png.",
        )
    if _DARK in positions.led_names:
        raise SessionError(
            f"an LED is named {_DARK!r}, as are the pictures with the LED dark", where="leds", remedy="Rename it."
        )
    warnings = [
        f"{path}: no camera is called {path.name!r}. {suggest(path.name, cameras, 'cameras')}"
        for path in sorted(folder.iterdir())
        if path.is_dir() and path.name not in cameras
    ]
    shots = []
    for camera in cameras:
        found, strangers = _sort(folder / camera, positions)
        shots.append(found)
        if not found:
            warnings.append(f"{folder / camera}: there are no pictures of this camera")
        elif strangers:
            warnings.append(f"{folder / camera}: {len(strangers)} files belong to no pose: {listed(strangers)}")
    album = Album(tuple(shots), tuple(warnings))
    if not album.count:
        raise SessionError(
            "there is no picture of any pose and camera",
            where=str(folder),
            remedy=f"They are to be called <camera>/<pose>{SUFFIXES[0]}; {listed(cameras)} are the cameras, "
            f"{listed(positions.poses[:3])} the first poses.",
        )
    return album


def _sort(folder: Path, positions: Positions) -> tuple[tuple[Shot, ...], list[str]]:
    """The shots in one camera's folder, and the names of image files that say nothing."""
    poses = {name: i for i, name in enumerate(positions.poses)}
    lit: dict[tuple[int, int], Path] = {}
    dark: dict[int, Path] = {}
    strangers = []
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    for path in files:
        if path.suffix.lower() not in SUFFIXES:
            continue
        # A pose's label may hold dots itself: the whole name first.
        label, _, last = (path.stem, "", "") if path.stem in poses else path.stem.rpartition(".")
        pose = poses.get(label)
        if pose is None or (last and last != _DARK and last not in positions.led_names):
            strangers.append(path.name)
        elif last == _DARK:
            _enter(dark, pose, path)
        else:
            _enter(lit, (pose, _led(last, path, positions.led_names)), path)
    shots = [Shot(pose, led, Picture(path, dark.get(pose))) for (pose, led), path in sorted(lit.items())]
    return tuple(shots), strangers


def _led(name: str, path: Path, leds: Sequence[str]) -> int:
    if name:
        return leds.index(name)
    if len(leds) > 1:
        raise SessionError(
            f"there are {len(leds)} LEDs, and the name does not say which is lit",
            where=str(path),
            remedy=f"Call it {path.stem}.{leds[0]}{path.suffix} or the like, one picture an LED.",
        )
    return 0


def _enter(table: dict[_K, Path], key: _K, path: Path) -> None:
    if key in table:
        raise SessionError(f"this is the same picture as {table[key].name}", where=str(path), remedy="Keep one.")
    table[key] = path
