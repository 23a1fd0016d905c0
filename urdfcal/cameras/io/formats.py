"""Camera files of all kinds: which kind a file is, and the way from one to another."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from urdfcal.cameras.io.entries import read_bytes
from urdfcal.cameras.io.kalibr import read_kalibr, write_kalibr
from urdfcal.cameras.io.opencv import read_opencv, write_opencv
from urdfcal.cameras.io.ros import read_ros, write_ros
from urdfcal.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.cameras.rig import Rig

__all__ = ["Format", "format_of", "read_cameras", "read_kalibr", "write_cameras", "write_kalibr"]

Format: TypeAlias = Literal["kalibr", "ros", "opencv"]


def format_of(path: Path) -> Format:
    """Tell a file's format by its content.

    OpenCV's files begin with %YAML or are XML, ROS's have the key camera_matrix or image_width on their own, and a
    camchain has the cameras' names.

    Raises:
        CameraError: it cannot be read.
    """
    data = read_bytes(path)
    if data.lstrip().startswith((b"%YAML", b"<")):
        return "opencv"
    return "ros" if re.search(rb"^(camera_matrix|image_width)[ \t]*:", data, re.MULTILINE) else "kalibr"


def read_cameras(paths: Sequence[str | Path], size: tuple[int, int] | None = None) -> Rig:
    """Read cameras from files of one format, told by their content.

    Args:
        paths: a Kalibr camchain, camera_info files in the order of the cameras, or OpenCV's files.
        size: (width, height) in px, for OpenCV files that do not tell.

    Raises:
        CameraError: a file cannot be read, or they are of different formats.
    """
    files = [Path(path) for path in paths]
    formats = [format_of(path) for path in files]
    if len(set(formats)) > 1:
        raise CameraError(f"the files are of different formats: {', '.join(formats)}", where=str(files[0]))
    if formats[0] == "ros":
        return read_ros(files)
    if formats[0] == "opencv":
        return read_opencv(files, size)
    if len(files) > 1:
        raise CameraError("a camchain is one file with all its cameras", where=str(files[1]))
    return read_kalibr(files[0])


def write_cameras(path: str | Path, rig: Rig, format_: Format) -> tuple[Path, ...]:
    """Write ``rig`` in a format and name the files written: one, but for a pair in ROS's format, which is a folder.

    Raises:
        CameraError: the format cannot say what the rig is.
        OutputError: it cannot be written.
    """
    path = Path(path)
    if format_ == "ros":
        return write_ros(path, rig)
    (write_kalibr if format_ == "kalibr" else write_opencv)(path, rig)
    return (path,)
