"""Finding a board in an image, whatever its light and focus; and what is there where it is not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.cameras.board.corners import Corners, refine
from urdfcal.images.files import channel

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from urdfcal.arrays import Floats
    from urdfcal.cameras.board.board import Board
    from urdfcal.images.files import Image

# Shares of corners where four squares meet, of real boards and soft, dim and compressed copies: at least 0.98 of boards
# found rightly, at most 0.92 of grids with rows left out; where a larger board has its next row, 0.5 and more if
# it is one and at most 0.22 if not.
_WHOLE, _GOES_ON = 0.93, 0.4
# Pictures up to this many pixels are looked at enlarged, too: that finds squares of 6 to 15 px in soft pictures (23 of
# 26 that were blurred by 3 px at half size; 16 without), and takes 0.1 s.
_SMALL = 1_500_000
# The largest of each family of dictionaries; it begins with the smaller ones.
_FAMILIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "APRILTAG_36h11", "ARUCO_ORIGINAL")
# A noisy wall shows a marker or two of 4 x 4 modules.
_FEWEST_MARKERS = 4
# Boards have at most this many squares in a row; of two widths the true one fits the markers far better.
_WIDEST, _BETTER = 40, 3.0


@dataclass(frozen=True)
class Seen:
    """What an image shows where a board is not found.

    Attributes:
        words: what is said of it.
        other: the other board that is there, by its dictionary or size; empty if none is recognized.
    """

    words: str
    other: str = ""


def detect_board(image: Image, board: Board) -> Corners | None:
    """Find the corners of ``board``.

    Args:
        image: (h, w) or (h, w, 3), 8 or 16 bit.
        board: a chessboard must be wholly in view, a ChArUco board may be cut or covered.

    Returns:
        The corners in the board's order (one of its orders, for a chessboard that looks the same from several
        sides), each with its covariance; None if there is no board, or another one.
    """
    eight = _eight_bit(image)
    start = next((_charuco if board.kind == "charuco" else _chessboards)(eight, board), None)
    corners = None if start is None else refine(channel(image, "any"), board, start)
    return corners if corners is not None and corners.found.any() else None


def what_is_seen(image: Image, board: Board) -> str:
    """Say why :func:`detect_board` finds nothing in ``image``: which board is there instead."""
    return seen_instead(image, board).words


def seen_instead(image: Image, board: Board) -> Seen:
    """Tell which board is in ``image`` where :func:`detect_board` finds nothing."""
    import cv2

    eight = _eight_bit(image)
    asked = " x ".join(map(str, board.shape))
    if board.kind == "charuco" and len(markers := _read_markers(eight, str(board.dictionary))) >= _FEWEST_MARKERS:
        return _otherwise_laid_out(markers, board)
    for name in _FAMILIES:
        if len(markers := _read_markers(eight, f"DICT_{name}")) >= _FEWEST_MARKERS:
            family = f"DICT_{name.removesuffix('_1000')}"
            what = f"markers of {family} up to number {max(markers)} were found"
            return Seen(f"{what}, {board.dictionary or 'a chessboard'} asked for", family)
    seen, _, squares = cv2.findChessboardCornersSBWithMeta(
        eight, (3, 3), cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    )
    size = " x ".join(map(str, sorted(squares.shape, reverse=True))) if seen else ""
    if seen and board.kind == "chessboard" and sorted(squares.shape) != sorted(board.shape):
        pairs = zip(sorted(squares.shape), sorted(board.shape), strict=True)
        cut = all(found <= whole for found, whole in pairs)  # it may be the one asked for, in part out of view
        return Seen(f"a board of {size} inner corners was found, {asked} asked for", "" if cut else size)
    if seen and board.kind == "charuco":
        return Seen(f"a chessboard of {size} inner corners was found, a ChArUco board asked for", size)
    hint = "; a chessboard must be wholly in view" if board.kind == "chessboard" else ""
    return Seen(f"no board is found in it{hint}")


def _otherwise_laid_out(markers: Mapping[int, Any], board: Board) -> Seen:
    """Tell how a ChArUco board with the right markers differs from the one asked for."""
    columns, rows, first = _laid_out(markers, board)
    if columns != board.columns or rows > board.rows:
        what = f"markers as on a board {columns} squares wide and {rows} or more high were found"
        return Seen(f"{what}, {board.columns} x {board.rows} asked for", f"{columns} x {rows}")
    if first != _first(board):
        words = f"its first square {'holds a marker' if first else 'is black'}: legacy: {str(first).lower()}"
        return Seen(words, words)
    return Seen("its markers are found, but no corner between them")


def _eight_bit(image: Image) -> Image:
    """The image in one channel of 8 bit, its board in the middle of their range."""
    if image.ndim == 2 and image.dtype == np.uint8:
        return image
    grey = channel(image, "any")
    # A few glaring pixels must not press the board into the dark end.
    low, high = np.percentile(grey[::4, ::4], [1.0, 99.0])
    scaled = (grey - low) * (235.0 / max(high - low, 1e-6)) + 10.0
    return np.asarray(np.clip(scaled, 0, 255).astype(np.uint8))


def _read_markers(image: Image, dictionary: str) -> dict[int, Any]:
    """The markers seen: number -> (1, 4, 2) px."""
    import cv2

    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    quads, ids, _ = cv2.aruco.ArucoDetector(family).detectMarkers(image)
    return {} if ids is None else dict(zip(np.ravel(ids).tolist(), quads, strict=True))


def _charuco(image: Image, board: Board) -> Iterator[Floats]:
    """The corners (N, 2) of a ChArUco board in an 8-bit image to a fraction of a pixel, px; NaN where none is seen."""
    import cv2

    corners, numbers, quads, ids = cv2.aruco.CharucoDetector(board.to_opencv()).detectBoard(image)
    if numbers is None or len(numbers) == 0:
        return
    # With the wrong counts corners are read between markers that are no neighbours.
    markers = dict(zip(np.ravel(ids).tolist(), quads, strict=True))
    if len(markers) >= _FEWEST_MARKERS and _laid_out(markers, board)[::2] != (board.columns, _first(board)):
        return
    uv = np.full((len(board.corners), 2), np.nan)
    uv[np.ravel(numbers)] = np.reshape(corners, (-1, 2))
    yield uv


def _first(board: Board) -> bool:
    """Whether the first square of a ChArUco board holds a marker, as OpenCV had it before 4.6 where rows are even."""
    return board.legacy and board.rows % 2 == 0


def _laid_out(markers: Mapping[int, Any], board: Board) -> tuple[int, int, bool]:
    """Columns of a ChArUco board that has its markers there, its least rows, and whether its first square holds one.

    The board asked for has the first say: of a few markers, or a single row of them, nothing tells the width.
    """
    import cv2

    centres = np.array([np.reshape(quad, (4, 2)).mean(axis=0) for quad in markers.values()])
    numbers = list(markers)

    def cells(columns: int, first: bool) -> Floats:
        rows = 2 * (max(numbers) + 1) // columns + 2
        j, i = np.nonzero((np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0) == first)
        return np.stack([i, j], axis=1)[numbers].astype(float)

    def misfit(columns: int, first: bool) -> float:
        places = cells(columns, first)
        H, _ = cv2.findHomography(places, centres)
        return np.inf if H is None else float(np.abs(cv2.perspectiveTransform(places[None], H)[0] - centres).mean())

    asked = board.columns, _first(board)
    others = {(columns, first): misfit(columns, first) for columns in range(3, _WIDEST) for first in (False, True)}
    best = min(others, key=lambda layout: others[layout])
    if misfit(*asked) < _BETTER * others[best] + 1.0:
        best = asked
    return best[0], int(cells(*best)[:, 1].max()) + 1, best[1]


def _chessboards(image: Image, board: Board) -> Iterator[Floats]:
    """The corners (N, 2) of a chessboard in an 8-bit image, as one detector after the other sees them, px.

    Each finds boards that the others miss; transposed, all find the same ones.
    """
    import cv2

    across, down = board.shape
    normalized, thorough = cv2.CALIB_CB_NORMALIZE_IMAGE, cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    larger = ((2, normalized),) if image.size < _SMALL else ()
    # Without its fast check the classic detector searches a plain noisy wall for ten seconds and more.
    classic = normalized | cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK
    for size, flags in ((1, normalized), (1, classic), (1, thorough), *larger, (1, 0)):
        enlarged = cv2.resize(image, None, fx=size, fy=size, interpolation=cv2.INTER_CUBIC) if size > 1 else image
        detector = cv2.findChessboardCorners if flags == classic else cv2.findChessboardCornersSB
        found, corners = detector(enlarged, board.shape, flags=flags)
        if not found:
            continue
        uv = (np.reshape(corners, (-1, 2)).astype(float) + 0.5) / size - 0.5
        if _is_whole(image, board, uv):
            yield _turned(uv.reshape(down, across, 2), image).reshape(-1, 2)


def _is_whole(image: Image, board: Board, uv: Floats) -> bool:
    """Whether four squares meet at all corners ``uv`` (N, 2), and at none where a larger board has its next ones.

    Detectors take a part of a larger board for a smaller one, and every other corner for neighbours.
    """
    across, down = board.shape
    grid = uv.reshape(down, across, 2)
    for axis in (0, 1):
        along = np.moveaxis(grid, axis, 0)
        # Quadratic: perspective and lens bend the lines.
        before, after = (np.tensordot([3.0, -3.0, 1.0], end, 1)[None] for end in (along[:3], along[:-4:-1]))
        grid = np.moveaxis(np.concatenate([before, along, after]), 0, axis)
    right, below = (0.25 * np.asarray(np.gradient(grid, axis=axis)) for axis in (1, 0))
    around = np.rint([grid - right - below, grid + right - below, grid + right + below, grid - right + below])
    inside = np.asarray(((around >= 0) & (around < image.shape[::-1])).all(axis=-1))
    u, v = np.moveaxis(np.where(inside[..., None], around, 0).astype(int), -1, 0)
    level = np.where(inside, image[v, u].astype(float), np.nan)
    j, i = np.indices(grid.shape[:2])
    contrast = np.where((i + j) % 2, -1.0, 1.0) * (level[0] - level[1] + level[2] - level[3])
    usual = np.nanmedian(contrast[1:-1, 1:-1])
    if not abs(usual) > 0.0:
        return False
    meets = np.nan_to_num(contrast / usual)
    sides = meets[0, 1:-1], meets[-1, 1:-1], meets[1:-1, 0], meets[1:-1, -1]
    return bool((meets[1:-1, 1:-1] > 0.5).mean() > _WHOLE) and all((side > 0.75).mean() < _GOES_ON for side in sides)


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
