"""Images of a calibration board as a camera would take them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from urdfcal.arrays import Floats
    from urdfcal.cameras.board.board import Board
    from urdfcal.cameras.camera import Camera

# Rays between these are interpolated by cubic splines: at 16 px, radtan of a 75° lens is met to 1e-7 px.
_RAY_SPACING = 16
# White paper and black ink under even light, in grey levels, on a darker wall.
_WHITE, _BLACK, _WALL = 200.0, 30.0, 90.0


@dataclass(frozen=True)
class BoardRenderer:
    """Renders boards through one camera's lens.

    Every pixel is the mean of ``oversampling``² samples, and every sample is the exact mean over its own area
    where it meets one edge, so an edge is in place to better than a thousandth of a pixel.

    Attributes:
        camera: the camera.
        oversampling: samples along a pixel's side.
    """

    camera: Camera
    oversampling: int = 2

    def render(
        self,
        board: Board,
        T_cam_board: Floats,
        *,
        blur: float = 0.8,
        noise: float = 0.0,
        smear: tuple[float, float] = (0.0, 0.0),
        rng: np.random.Generator | None = None,
    ) -> NDArray[np.uint8]:
        """Take an image.

        Args:
            board: what is seen, printed with a white margin one square wide.
            T_cam_board: where it is, (4, 4).
            blur: standard deviation of the point spread, px.
            noise: standard deviation of a pixel, grey levels.
            smear: way of the image during the exposure, px.
            rng: draws the noise; needed if there is any.

        Returns:
            (height, width) grey levels.
        """
        import cv2

        lines, shades = _drawing(board)
        reach = int(np.ceil(5.0 * blur + np.hypot(*smear))) + 2
        rows, columns = self._window(lines, T_cam_board, reach)
        width, height = self.camera.resolution
        image = np.full((height, width), _WALL, dtype=np.float32)
        if rows.stop > rows.start and columns.stop > columns.start:
            patch = self._sampled(lines, shades, T_cam_board, rows, columns)
            if blur > 0.0:
                patch = cv2.GaussianBlur(patch, (0, 0), blur * self.oversampling, borderType=cv2.BORDER_REPLICATE)
            if any(smear):
                patch = cv2.filter2D(patch, -1, self._smearing(smear), borderType=cv2.BORDER_REPLICATE)
            size = columns.stop - columns.start, rows.stop - rows.start
            image[rows, columns] = cv2.resize(patch, size, interpolation=cv2.INTER_AREA)
        if noise > 0.0:
            if rng is None:
                raise ValueError("noise needs a random generator")
            image += noise * rng.standard_normal(image.shape, dtype=np.float32)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def _smearing(self, smear: tuple[float, float]) -> NDArray[np.float32]:
        """The kernel of a straight motion, in samples."""
        way = self.oversampling * np.array(smear)
        middle = int(np.ceil(0.5 * np.abs(way).max())) + 1
        kernel = np.zeros((2 * middle + 1, 2 * middle + 1), dtype=np.float32)
        parts = np.linspace(-0.5, 0.5, 16 * middle)
        for x, y in np.rint(middle + parts[:, None] * way).astype(int):
            kernel[y, x] += 1.0 / len(parts)
        return kernel

    def _window(self, lines: tuple[Floats, Floats], T_cam_board: Floats, reach: int) -> tuple[slice, slice]:
        """Rows and columns of the image that the paper can be in, and ``reach`` px around them."""
        (left, *_, right), (top, *_, bottom) = lines
        along = np.linspace(0.0, 1.0, 33)
        x, y = left + (right - left) * along, top + (bottom - top) * along
        edges = ((x, top), (x, bottom), (left, y), (right, y))
        outline = np.concatenate([np.stack(np.broadcast_arrays(*edge, 0.0), axis=1) for edge in edges])
        uv = self.camera.project(outline @ T_cam_board[:3, :3].T + T_cam_board[:3, 3])
        size = np.array(self.camera.resolution)
        if np.isnan(uv).any():
            return slice(0, int(size[1])), slice(0, int(size[0]))
        low = np.clip(np.floor(uv.min(axis=0)).astype(int) - reach, 0, size)
        high = np.clip(np.ceil(uv.max(axis=0)).astype(int) + reach, low, size)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    @cached_property
    def _rays(self) -> NDArray[np.float32]:
        """(h, w, 2) where the samples look on the plane z = 1; single precision is 1e-4 px."""
        from scipy.interpolate import RectBivariateSpline

        width, height = self.camera.resolution
        knots = [np.linspace(-0.5, side - 0.5, max(5, side // _RAY_SPACING)) for side in (height, width)]
        step = 1.0 / self.oversampling
        fine = [-0.5 + step * (np.arange(side * self.oversampling) + 0.5) for side in (height, width)]
        v, u = np.meshgrid(*knots, indexing="ij")
        rays = self.camera.unproject(np.stack([u, v], axis=-1))
        return np.stack([RectBivariateSpline(*knots, rays[..., i])(*fine).astype(np.float32) for i in (0, 1)], axis=-1)

    def _sampled(
        self, lines: tuple[Floats, Floats], shades: Floats, T_cam_board: Floats, rows: slice, columns: slice
    ) -> NDArray[np.float32]:
        """The part of the image before any blur, at the samples."""
        fine = [slice(self.oversampling * s.start, self.oversampling * s.stop) for s in (rows, columns)]
        rays = self._rays[fine[0], fine[1]]
        # A point (x, y, 0) of the board is seen along H (x, y, 1); the last component is then 1 / depth.
        H = np.linalg.inv(T_cam_board[:3, [0, 1, 3]]).astype(np.float32)
        x, y, inverse_depth = (H[i, 0] * rays[..., 0] + H[i, 1] * rays[..., 1] + H[i, 2] for i in range(3))
        in_front = inverse_depth > 0.0
        depth = 1.0 / np.where(in_front, inverse_depth, np.float32(np.inf))
        (i, a), (j, b) = (
            _between(ruled.astype(np.float32), place * depth) for ruled, place in zip(lines, (x, y), strict=True)
        )
        shades = shades.astype(np.float32)
        above = shades[j, i] * (1.0 - a) + shades[j, i + 1] * a
        below = shades[j + 1, i] * (1.0 - a) + shades[j + 1, i + 1] * a
        return np.where(in_front, above * (1.0 - b) + below * b, np.float32(_WALL))


def _between(lines: NDArray[np.float32], x: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """For every sample, the cell before its nearest line, and the share of the sample that lies after that line."""
    nearest = np.clip(np.searchsorted(0.5 * (lines[1:] + lines[:-1]), x), 0, len(lines) - 1)
    down, across = np.gradient(x)
    steepness = np.sqrt(down * down + across * across)
    share = np.clip(0.5 + (x - lines[nearest]) / np.maximum(steepness, np.float32(1e-30)), 0.0, 1.0)
    return nearest, share


def _drawing(board: Board) -> tuple[tuple[Floats, Floats], Floats]:
    """The board as a grid of lines across x and across y (m) and the shades of the cells between them.

    The shades have one more row and column than there are lines: the wall around the paper.
    """
    across, down = (count + 1 for count in board.shape)
    marks, modules, markers = np.zeros(0), 0, {}
    if board.kind == "charuco":
        import cv2

        printed = board.to_opencv()
        dictionary = printed.getDictionary()
        modules = dictionary.markerSize + 2
        side = float(board.marker or 0.0) / board.square
        marks = 0.5 * (1.0 - side) + side * np.arange(modules + 1) / modules
        cells = [(i, j) for j in range(down) for i in range(across) if (i + j) % 2]
        markers = {
            cell: cv2.aruco.generateImageMarker(dictionary, int(number), modules) > 0
            for cell, number in zip(cells, np.ravel(printed.getIds()), strict=True)
        }

    def ruled(squares: int) -> Floats:
        inner = (np.arange(squares)[:, None] + np.concatenate([[0.0], marks])).ravel()
        return np.concatenate([[-1.0], inner, [squares, squares + 1.0]])

    step = len(marks) + 1
    shades = np.full((down * step + 2, across * step + 2), _WHITE)
    for j in range(down):
        for i in range(across):
            block = shades[1 + j * step : 1 + (j + 1) * step, 1 + i * step : 1 + (i + 1) * step]
            if (i + j) % 2 == 0:
                block[:] = _BLACK
            elif (i, j) in markers:
                block[1:-1, 1:-1] = np.where(markers[i, j], _WHITE, _BLACK)
    # The first inner corner is the origin, one square from the edge of the first square.
    lines = tuple(board.square * (ruled(count) - 1.0) for count in (across, down))
    return (lines[0], lines[1]), np.pad(shades, 1, constant_values=_WALL)
