"""Camera files of all kinds: which kind a file is, and the way from one to another."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from urdfcal.cameras.io.entries import read_bytes
from urdfcal.cameras.io.kalibr import read_kalibr, write_kalibr
from urdfcal.cameras.io.opencv import read_opencv, write_opencv
from urdfcal.cameras.io.ros import from_left, read_ros, write_ros
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
        paths: a Kalibr camchain, camera_info files in the order of the cameras, or OpenCV's files; or a folder with
            such files and nothing else that ends in .yaml, .yml or .xml, as a pair in ROS's format is.
        size: (width, height) in px, for OpenCV files that do not tell.

    Raises:
        CameraError: a file cannot be read, or they are of different formats.
    """
    files = [file for path in map(Path, paths) for file in (_inside(path) if path.is_dir() else [path])]
    formats = [format_of(path) for path in files]
    if len(set(formats)) > 1:
        raise CameraError(f"the files are of different formats: {', '.join(formats)}", where=str(files[0]))
    if formats[0] == "ros":
        return read_ros(from_left(files) if Path(paths[0]).is_dir() else files)
    if formats[0] == "opencv":
        return read_opencv(files, size)
    if len(files) > 1:
        raise CameraError("a camchain is one file with all its cameras", where=str(files[1]))
    return read_kalibr(files[0])


def _inside(folder: Path) -> list[Path]:
    """The camera files in a folder."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".yaml", ".yml", ".xml"))
    if not files:
        raise CameraError("there are no camera files (.yaml, .yml, .xml) in this folder", where=str(folder))
    return files


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
