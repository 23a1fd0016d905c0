"""Finding a calibration board in a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.cameras.board.corners import Corners, refine
from urdfcal.images.files import channel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from urdfcal.arrays import Floats
    from urdfcal.cameras.board.board import Board


def detect_board(image: NDArray[Any], board: Board) -> Corners | None:
    """Find the corners of ``board``.

    Args:
        image: (h, w) or (h, w, 3), 8 or 16 bit.
        board: a chessboard must be wholly in view, a ChArUco board may be cut or covered.

    Returns:
        The corners in the board's order (one of its orders, for a chessboard that looks the same from several
        sides); None if there is no board.
    """
    grey = channel(image, "any")
    eight = image if image.shape == grey.shape and image.dtype == np.uint8 else _eight_bit(grey)
    start = _charuco(eight, board) if board.kind == "charuco" else _chessboard(eight, board)
    if start is None:
        return None
    return refine(grey, board, start)


def _eight_bit(grey: NDArray[np.float32]) -> NDArray[np.uint8]:
    # A few glaring pixels must not press the board into the dark end.
    low, high = np.percentile(grey[::4, ::4], [1.0, 99.0])
    scaled = (grey - low) * (235.0 / max(high - low, 1e-6)) + 10.0
    return np.asarray(np.clip(scaled, 0, 255), dtype=np.uint8)


def _charuco(image: NDArray[Any], board: Board) -> Floats | None:
    import cv2

    corners, numbers, _, _ = cv2.aruco.CharucoDetector(board.to_opencv()).detectBoard(image)
    if numbers is None or len(numbers) == 0:
        return None
    uv = np.full((len(board.corners), 2), np.nan)
    uv[np.ravel(numbers)] = np.reshape(corners, (-1, 2))
    return uv


def _chessboard(image: NDArray[Any], board: Board) -> Floats | None:
    import cv2

    # findChessboardCorners finds no more boards, and searches a plain noisy wall for ten seconds and more.
    found, corners = cv2.findChessboardCornersSB(image, board.shape, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    across, down = board.shape
    return _turned(np.asarray(corners, dtype=float).reshape(down, across, 2), image).reshape(-1, 2)


def _turned(grid: Floats, image: NDArray[Any]) -> Floats:
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
