"""A folder of images of a board, and the board's corners in them to a hundredth of a pixel."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, frozen
from urdfcal.errors import CameraError
from urdfcal.images.files import SUFFIXES, channel, in_parallel, read_image

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.cameras.board.board import Board
    from urdfcal.images.files import Image

# Further out there is little left to learn, and the lens bends the edges.
_REACH = 8
# Share of a square that a corner's window reaches into: the edges of the next corner must not show.
_SHARE = 0.42
# Two-dimensional fits with fewer pixels than this are noise.
_FEWEST_PIXELS = 24
# The detectors are right to about 0.2 px; a fit that walks further has found something else.
_FARTHEST_STEP = 1.5
_MAX_STEPS = 30
_CONVERGED = 1e-4
# Standard deviation at which a fit starts and the range of what it may find, px.
_BLUR, _SHARPEST, _SOFTEST = 0.9, 0.25, 6.0


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
        blur: (C, V) median standard deviation of the edges' blur, px; NaN where there is nothing.
        rejected: images with nothing of use.
    """

    cameras: tuple[str, ...]
    resolutions: tuple[tuple[int, int], ...]
    views: tuple[str, ...]
    uv: Floats
    blur: Floats
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
    blur = np.full((len(cameras), len(views)), np.nan)
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
                uv[c, v], blur[c, v] = found.uv, np.nanmedian(found.blur)
                continue
            rejected.append(Rejection(camera, path.stem, reason))
    return BoardViews(cameras, tuple(resolutions), views, frozen(uv), frozen(blur), tuple(rejected))


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
    if corners is None or not corners.found.any():
        part = "; a chessboard must be wholly in view" if board.kind == "chessboard" else ""
        return size, f"no board is found in it{part}"
    return size, corners


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts cam2 before cam10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _sorted(folder: Path) -> list[Path]:
    return sorted(folder.iterdir(), key=lambda path: _natural(path.name))


@dataclass(frozen=True, eq=False)
class Corners:
    """What one image shows of a board.

    Attributes:
        uv: (N, 2) px, all inner corners in the board's order; NaN where one was not found.
        blur: (N,) standard deviation of the edges' blur, the wider of the two edges, px; NaN likewise.
    """

    uv: Floats
    blur: Floats

    @property
    def found(self) -> Bools:
        """(N,) which corners were found."""
        return np.isfinite(self.uv[:, 0])


def detect_board(image: Image, board: Board) -> Corners | None:
    """Find the corners of ``board``.

    Args:
        image: (h, w) or (h, w, 3), 8 or 16 bit.
        board: a chessboard must be wholly in view, a ChArUco board may be cut or covered.

    Returns:
        The corners in the board's order (one of its orders, for a chessboard that looks the same from several
        sides); None if there is no board.
    """
    grey = channel(image, "any")
    eight = image
    if image.shape != grey.shape or image.dtype != np.uint8:
        # A few glaring pixels must not press the board into the dark end.
        low, high = np.percentile(grey[::4, ::4], [1.0, 99.0])
        scaled = (grey - low) * (235.0 / max(high - low, 1e-6)) + 10.0
        eight = np.clip(scaled, 0, 255).astype(np.uint8)
    start = _rough(eight, board)
    return None if start is None else refine(grey, board, start)


def refine(image: Image, board: Board, uv: Floats) -> Corners:
    """Find the corners near ``uv``.

    Around a corner at c the image is ``m + h erf(n1·(x - c) / (√2 s1)) erf(n2·(x - c) / (√2 s2))``, with an
    angle and a blur for either edge. True image and model look the same turned by half around c, whatever the
    blur, the camera's tone curve and the light's level, which leaves no bias to first order.

    Args:
        image: (h, w) grey levels.
        board: what is seen.
        uv: (N, 2) px, right to about a pixel; NaN where a corner was not seen.
    """
    directions = _squares(board, uv)
    at = np.flatnonzero(np.isfinite(directions).all(axis=(1, 2)))
    height, width = image.shape
    margin = _REACH + 1
    origin = np.rint(uv[at]).astype(int)
    inside = ((origin >= margin) & (origin < np.array([width, height]) - margin)).all(axis=1)
    at, origin = at[inside], origin[inside]
    found = Corners(np.full_like(uv, np.nan), np.full(len(uv), np.nan))
    if not at.size:
        return found
    offsets = np.stack(np.meshgrid(*[np.arange(-_REACH, _REACH + 1)] * 2), axis=-1).reshape(-1, 2).astype(float)
    pixels = origin[:, None] + offsets.astype(int)
    windows = image[pixels[..., 1], pixels[..., 0]].astype(float)
    weights = _weights(board, directions[at], offsets - (uv[at] - origin)[:, None])
    enough = weights.sum(axis=1) >= _FEWEST_PIXELS
    at, origin, windows, weights = at[enough], origin[enough], windows[enough], weights[enough]
    parameters, good = _fit(windows, weights, offsets, uv[at] - origin, directions[at])
    good &= np.linalg.norm(parameters[:, :2] - (uv[at] - origin), axis=1) < _FARTHEST_STEP
    found.uv[at[good]] = origin[good] + parameters[good, :2]
    found.blur[at[good]] = parameters[good, 4:6].max(axis=1)
    return found


def _squares(board: Board, uv: Floats) -> Floats:
    """(N, 2, 2) how far one square to the right and one down reach in the image, px; NaN if too little is seen.

    From the corner's neighbours rather than a homography, which a fisheye does not obey.
    """
    across, down = board.shape
    grid = np.pad(uv.reshape(down, across, 2), ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    here = grid[1:-1, 1:-1]
    steps = []
    for before, after in ((grid[1:-1, :-2], grid[1:-1, 2:]), (grid[:-2, 1:-1], grid[2:, 1:-1])):
        step = 0.5 * (after - before)
        for alone in (after - here, here - before):
            step = np.where(np.isfinite(step), step, alone)
        steps.append(step)
    return np.stack(steps, axis=-2).reshape(-1, 2, 2)


def _weights(board: Board, directions: Floats, d: Floats) -> Floats:
    """(n, K) which pixels of each window show this corner's two edges and nothing else."""
    ab = np.abs(d @ np.linalg.inv(directions))
    shown = (ab < _SHARE).all(axis=-1) & (np.linalg.norm(d, axis=-1) <= _REACH)
    if board.marker is not None:
        # Markers leave a frame around the edges, in squares; their blur reaches some pixels out of them.
        frame = 0.5 * (1.0 - board.marker / board.square)
        size = np.linalg.norm(directions, axis=2).min(axis=1)[:, None]
        shown &= ab.min(axis=-1) < frame - np.minimum(2.0 * _BLUR / size, 0.5 * frame)
    return np.asarray(shown.astype(float))


def _fit(windows: Floats, weights: Floats, offsets: Floats, start: Floats, directions: Floats) -> tuple[Floats, Bools]:
    """Damped Gauss-Newton for all corners at once.

    Returns:
        (n, 8) c (2), angles (2), blurs (2), m, h; and (n,) whether it converged to a corner.
    """
    n = len(windows)
    angles = np.arctan2(directions[..., 1], directions[..., 0])
    p = np.concatenate([start, angles, np.full((n, 2), _BLUR), np.zeros((n, 2))], axis=1)
    # m and h enter linearly.
    shape = _model(p, offsets)[1][..., 7]
    total = weights.sum(axis=1)
    mean, middle = (weights * windows).sum(axis=1) / total, (weights * shape).sum(axis=1) / total
    spread = (weights * (shape - middle[:, None]) ** 2).sum(axis=1)
    p[:, 7] = (weights * (shape - middle[:, None]) * windows).sum(axis=1) / np.maximum(spread, 1e-12)
    p[:, 6] = mean - p[:, 7] * middle

    value, J = _model(p, offsets)
    cost = (weights * (windows - value) ** 2).sum(axis=1)
    damping = np.full(n, 1e-3)
    step = np.full((n, 2), np.inf)
    for _ in range(_MAX_STEPS):
        JtW = np.swapaxes(J * weights[..., None], 1, 2)
        H, g = JtW @ J, (JtW @ (windows - value)[..., None])[..., 0]
        diagonal = np.einsum("nii->ni", H)
        H = H + damping[:, None, None] * np.eye(8) * np.maximum(diagonal, 1e-9)[:, None, :]
        move = np.linalg.solve(H, g[..., None])[..., 0]
        trial = p + move
        trial[:, 4:6] = np.clip(trial[:, 4:6], _SHARPEST, _SOFTEST)
        new_value, new_J = _model(trial, offsets)
        new_cost = (weights * (windows - new_value) ** 2).sum(axis=1)
        better = new_cost <= cost
        p[better], value[better], J[better] = trial[better], new_value[better], new_J[better]
        cost[better] = new_cost[better]
        step[better] = np.abs(move[better, :2])
        damping = np.where(better, damping / 10.0, damping * 10.0)
        if (step.max(axis=1) < _CONVERGED).all():
            break
    contrast = np.abs(p[:, 7])
    rms = np.sqrt(cost / total)
    # On a corner the edges explain the window; 0.2 of the contrast is left where a highlight or a finger is.
    good = (step.max(axis=1) < 1e-2) & (rms < 0.2 * contrast) & (p[:, 4:6] < 0.99 * _SOFTEST).all(axis=1)
    return p, good


def _model(p: Floats, offsets: Floats) -> tuple[Floats, Floats]:
    """The image (n, K) of corners ``p`` (n, 8) and its derivative (n, K, 8)."""
    from scipy.special import erf

    d = offsets - p[:, None, :2]
    sides, slopes, along = [], [], []
    for i in (0, 1):
        c, s = np.cos(p[:, 2 + i, None]), np.sin(p[:, 2 + i, None])
        blur = p[:, 4 + i, None]
        across = (c * d[..., 1] - s * d[..., 0]) / blur
        sides.append(erf(across / np.sqrt(2.0)))
        slopes.append(np.sqrt(2.0 / np.pi) * np.exp(-0.5 * across**2) / blur)
        along.append((across, c * d[..., 0] + s * d[..., 1], c, s))
    shape = sides[0] * sides[1]
    h = p[:, 7, None]
    J = np.zeros((*shape.shape, 8))
    for i in (0, 1):
        across, forward, c, s = along[i]
        slope = h * slopes[i] * sides[1 - i]
        J[..., 0] += slope * s
        J[..., 1] -= slope * c
        J[..., 2 + i] = -slope * forward
        J[..., 4 + i] = -slope * across
    J[..., 6] = 1.0
    J[..., 7] = shape
    return p[:, 6, None] + h * shape, J


def _rough(image: Image, board: Board) -> Floats | None:
    """The corners (N, 2) of a board in an 8-bit image to a fraction of a pixel, px."""
    import cv2

    if board.kind == "charuco":
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(board.to_opencv()).detectBoard(image)
        if numbers is None or len(numbers) == 0:
            return None
        uv = np.full((len(board.corners), 2), np.nan)
        uv[np.ravel(numbers)] = np.reshape(corners, (-1, 2))
        return uv
    # findChessboardCorners finds no more boards, and searches a plain noisy wall for ten seconds and more.
    found, corners = cv2.findChessboardCornersSB(image, board.shape, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    across, down = board.shape
    return _turned(np.reshape(corners, (down, across, 2)).astype(float), image).reshape(-1, 2) if found else None


def _turned(grid: Floats, image: Image) -> Floats:
    """Corners (rows, columns, 2) turned so that x goes right of y and the square up and left of the first is black."""
    right, below = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * below[1] - right[1] * below[0] < 0.0:
        grid = grid[:, ::-1]
    down, across = grid.shape[:2]
    centres = np.rint(0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])).astype(int)
    level = image[centres[..., 1], centres[..., 0]].astype(float)
    j, i = np.indices(level.shape)
    # The square down and right of the first corner has the colour of the one up and left of it.
    if np.sum(np.where((i + j) % 2 == 0, 1.0, -1.0) * (level - level.mean())) > 0.0:
        if (across + down) % 2:
            return grid[::-1, ::-1]
        if across == down and across % 2:
            return np.rot90(grid)
    return grid
