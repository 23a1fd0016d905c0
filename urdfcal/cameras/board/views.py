"""A folder of images of a board: what every camera saw of it, and why an image shows nothing of use."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.cameras.board.detection import detect_board, what_is_seen
from urdfcal.errors import CameraError
from urdfcal.images.files import SUFFIXES, in_parallel, read_image

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.cameras.board.board import Board
    from urdfcal.cameras.board.corners import Corners


# Beyond this the edges of the next squares, and of the board, spill into a corner's window: real pictures of squares of
# 15 px blurred by 3 px gave focal lengths off by 0.5 %, 4 standard deviations. At 0.12 they are right.
_SOFTEST = 0.15


@dataclass(frozen=True)
class Rejection:
    """An image that was not used.

    Attributes:
        camera: its name.
        view: the image's name without suffix.
        reason: in words.
    """

    camera: str
    view: str
    reason: str


@dataclass(frozen=True, eq=False)
class BoardViews:
    """What C cameras saw of a board in V views.

    Attributes:
        cameras: their names; the first one's frame is the world.
        resolutions: (width, height) of each camera, px.
        views: their names; images of the same name were taken at the same time.
        uv: (C, V, N, 2) px, NaN where a corner was not found.
        covariance: (C, V, N, 2, 2) of them, px², NaN likewise.
        rejected: images with nothing of use.
    """

    cameras: tuple[str, ...]
    resolutions: tuple[tuple[int, int], ...]
    views: tuple[str, ...]
    uv: Floats
    covariance: Floats
    rejected: tuple[Rejection, ...]


def read_views(folder: Path, board: Board, progress: Callable[[int], None] | None = None) -> BoardViews:
    """Find ``board`` in the images ``folder``/<camera>/<view>.png; a folder of images is one camera, cam0.

    Args:
        folder: cameras are in the order of their names, numbers in them counted as numbers.
        board: what to look for.
        progress: called with 1 after every image.

    Raises:
        CameraError: there are no images.
    """
    images = find_images(folder)
    paths = [(camera, path) for camera, found in images.items() for path in found.values()]
    results = list(in_parallel(lambda item: _look(item[1], board), paths, progress=progress))
    cameras = tuple(images)
    views = tuple(sorted({view for found in images.values() for view in found}, key=_natural))
    uv = np.full((len(cameras), len(views), len(board.corners), 2), np.nan)
    covariance = np.full((*uv.shape, 2), np.nan)
    rejected, resolutions = [], []
    for c, camera in enumerate(cameras):
        mine = [(path, *result) for (name, path), result in zip(paths, results, strict=True) if name == camera]
        sizes = Counter(size for _, size, _ in mine if all(size))
        if not sizes:
            raise CameraError("none of its files is an image", where=str(folder / camera))
        usual = sizes.most_common(1)[0][0]
        resolutions.append(usual)
        for path, size, found in mine:
            v = views.index(path.stem)
            if all(size) and size != usual:
                reason = f"it has {size[0]} x {size[1]} pixels, the others {usual[0]} x {usual[1]}"
            elif isinstance(found, str):
                reason = found
            else:
                uv[c, v], covariance[c, v] = found.uv, found.covariance
                continue
            rejected.append(Rejection(camera, path.stem, reason))
    return BoardViews(cameras, tuple(resolutions), views, frozen(uv), frozen(covariance), tuple(rejected))


def find_images(folder: Path) -> dict[str, dict[str, Path]]:
    """Camera name -> view name -> image, both in natural order.

    Raises:
        CameraError: there are none, or two of the same name.
    """
    if not folder.is_dir():
        raise CameraError("there is no such folder", where=str(folder))
    inside = [path for path in _sorted(folder) if path.is_dir() and not path.name.startswith(".")]
    found = {path.name: views for path in inside if (views := _images(path))}
    if not found and (alone := _images(folder)):
        found = {"cam0": alone}
    if not found:
        remedy = "Put them into one folder a camera: <camera>/<view>.png."
        raise CameraError(f"there are no images ({', '.join(SUFFIXES)}) here", where=str(folder), remedy=remedy)
    return found


def _images(folder: Path) -> dict[str, Path]:
    images: dict[str, Path] = {}
    for path in _sorted(folder):
        if path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
            if path.stem in images:
                what = f"{path.name} and {images[path.stem].name} are both called '{path.stem}'"
                raise CameraError(what, where=str(folder))
            images[path.stem] = path
    return images


def _look(path: Path, board: Board) -> tuple[tuple[int, int], Corners | str]:
    """The image's (width, height) and its corners, or why there are none."""
    try:
        image = read_image(path)
    except CameraError as error:
        return (0, 0), error.what
    size = image.shape[1], image.shape[0]
    corners = detect_board(image, board)
    if corners is None:
        return size, what_is_seen(image, board)
    blur, square = float(np.nanmedian(corners.blur)), corners.squares(board)
    if blur > _SOFTEST * square:
        return size, f"it is too soft: edges are blurred by {blur:.1f} px (standard deviation), squares {square:.0f} px"
    return size, corners


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts cam2 before cam10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _sorted(folder: Path) -> list[Path]:
    return sorted(folder.iterdir(), key=lambda path: _natural(path.name))
