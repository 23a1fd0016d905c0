"""URDF files found by a plain path, or by ``package://name/...`` in the packages installed on this machine."""

from __future__ import annotations

import os
import re
import sys
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from urdfcal.errors import RobotError
from urdfcal.names import listed

if TYPE_CHECKING:
    from collections.abc import Iterator

SCHEME = "package://"

# A catkin workspace has its packages at src/repository/group/package at most; ROS distributions and
# workspaces have a few hundred folders above their packages. Someone's home folder has a million.
_DEPTH = 4
_FOLDERS = 2000
_IGNORE = ("CATKIN_IGNORE", "COLCON_IGNORE", "AMENT_IGNORE")
_VARIABLES = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
# Unlike pathlib's, these do not raise at forbidden or overlong paths.
_is_file, _is_folder = os.path.isfile, os.path.isdir


def find_urdf(reference: str | Path, relative_to: Path | None = None) -> Path:
    """Find the file that ``reference`` names.

    Args:
        reference: a path, or ``package://name/path/in/the/package``.
        relative_to: folder that a relative path starts from; the working folder by default.

    Raises:
        RobotError: there is no such package or file, or the reference leads out of its package.
    """
    if str(reference).startswith(SCHEME):
        return _in_package(str(reference))
    path = Path(reference) if relative_to is None else relative_to / reference
    if not _is_file(path):
        raise _no_file(path)
    return path


def package_roots() -> list[Path]:
    """List the folders whose children are packages, in order of precedence.

    They come from ROS_PACKAGE_PATH (folders of packages, nested as in a catkin workspace, or packages
    themselves), AMENT_PREFIX_PATH (``prefix/share``), and the installed example-robot-data.
    """
    roots: list[Path] = []
    for entry in _entries("ROS_PACKAGE_PATH"):
        if _is_file(entry / "package.xml"):
            roots.append(entry.parent)
        else:
            roots += [entry, *(package.parent for package in _packages_below(entry))]
    roots += [prefix / "share" for prefix in _entries("AMENT_PREFIX_PATH")]
    roots += _example_robot_data()
    return [root for root in dict.fromkeys(roots) if _is_folder(root)]


def _in_package(reference: str) -> Path:
    name, _, rest = reference.removeprefix(SCHEME).partition("/")
    # Joined part by part: an absolute rest would replace the package's folder.
    inside = Path(os.path.normpath(Path(*(part for part in rest.split("/") if part))))
    if name in ("", ".", ".."):
        raise RobotError("no package is named", where=reference, remedy="Write package://name/path/robot.urdf.")
    if inside.parts[:1] == ("..",) or inside.is_absolute():
        raise RobotError(
            f"'..' leads out of package {name!r}", where=reference, remedy="Name a file inside the package, or a path."
        )
    folders = _package_folders(name)
    if not folders:
        searched = [f"{variable} ({os.environ.get(variable) or 'not set'})" for variable in _VARIABLES]
        raise RobotError(
            f"there is no package {name!r}",
            where=reference,
            remedy=f"Searched {' and '.join(searched)} and the installed example-robot-data; "
            "add the folder that contains it to ROS_PACKAGE_PATH.",
        )
    for folder in folders:
        if _is_file(folder / inside):
            return folder / inside
    raise _no_file(folders[0] / inside)


def _package_folders(name: str) -> list[Path]:
    roots = package_roots()
    folders = [root / name for root in roots if _is_folder(root / name)]
    # A package's true name is in its package.xml; a cloned folder may be called otherwise.
    return folders or [child for root in roots for child in _children(root) if _declared_name(child) == name]


def _declared_name(package: Path) -> str | None:
    try:
        manifest = (package / "package.xml").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    found = re.search(r"<name>\s*(\S+?)\s*</name>", manifest)
    return found[1] if found else None


def _packages_below(folder: Path) -> Iterator[Path]:
    """Yield the packages below ``folder``, nearest first; packages hold no packages."""
    level = [folder]
    budget = _FOLDERS
    for _ in range(_DEPTH):
        below: list[Path] = []
        for child in islice((child for parent in level for child in _children(parent)), budget):
            budget -= 1
            if any(_is_file(child / marker) for marker in _IGNORE):
                continue
            if _is_file(child / "package.xml"):
                yield child
            else:
                below.append(child)
        level = below


def _children(folder: Path) -> list[Path]:
    """List the visible folders in ``folder``; none when it cannot be read."""
    try:
        with os.scandir(folder) as entries:
            names = sorted(entry.name for entry in entries if not entry.name.startswith(".") and entry.is_dir())
    except OSError:
        return []
    return [folder / name for name in names]


def _entries(variable: str) -> list[Path]:
    return [Path(entry) for entry in os.environ.get(variable, "").split(os.pathsep) if entry]


def _example_robot_data() -> list[Path]:
    """List where example-robot-data may be: beside its Python distribution, or in the environment (conda)."""
    from importlib import metadata  # brings zipfile and email along

    folders = [Path(sys.prefix) / "share"]
    with suppress(metadata.PackageNotFoundError):
        # Asked of the distribution, as importing it would import all of Pinocchio.
        distribution = metadata.distribution("example-robot-data")
        folders.insert(0, Path(str(distribution.locate_file("cmeel.prefix/share"))))
    return [folder for folder in folders if _is_folder(folder / "example-robot-data")]


def _no_file(path: Path) -> RobotError:
    if _is_folder(path):
        what, folder = "this is a folder, not a URDF", path
    else:
        what, folder = "there is no such file", path.parent
    if not _is_folder(folder):
        return RobotError(what, where=str(path), remedy=f"There is no folder {folder} either.")
    others = sorted(file.name for file in folder.glob("*.urdf"))
    return RobotError(what, where=str(path), remedy=f"That folder has: {listed(others)}." if others else "")
