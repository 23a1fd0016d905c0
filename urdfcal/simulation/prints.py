"""Printed boards and tags as a camera sees them: paper and ink through its lens, to a thousandth of a pixel."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.rotations import rpy_to_matrix
from urdfcal.session.pattern import ChessboardPattern, CirclesPattern, TagsPattern

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from urdfcal.arrays import Floats, Ints
    from urdfcal.cameras.board.board import Board
    from urdfcal.cameras.camera import Camera
    from urdfcal.session.pattern import Pattern

WHITE, BLACK, WALL = 200.0, 30.0, 90.0
"""White paper and black ink under even light, in grey levels of 255, on a darker wall."""

# Rays between these are interpolated by cubic splines: at 16 px, radtan of a 75 degree lens is met to 1e-7 px. [px]
_RAY_SPACING = 16
# Each meeting of a ray with a bulging print leaves a hundredth of the error of the one before.
_MEETINGS = 4
# Radius of a dot over its grid's spacing; an asymmetric grid's nearest neighbours are sqrt(2) of it apart.
_DOT = 0.3


class Print(ABC):
    """Something flat that is printed on paper, in the plane z = 0 of its frame."""

    @property
    @abstractmethod
    def paper(self) -> tuple[Floats, Floats]:
        """Lower and upper corner (2,) of the paper. [m]."""

    @abstractmethod
    def shades(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Grey levels (h, w) of samples at these places, each the mean over its own area where it meets one edge."""


@dataclass(frozen=True, eq=False)
class GridPrint(Print):
    """Rectangular cells between lines across x and across y.

    Attributes:
        lines: where they are, across x and across y. [m]
        cells: (rows, columns) grey levels, a row and a column more than lines: the outermost lie off the paper.
    """

    lines: tuple[Floats, Floats]
    cells: Floats

    @property
    def paper(self) -> tuple[Floats, Floats]:
        """Lower and upper corner (2,) of the paper. [m]."""
        return np.array([of[0] for of in self.lines]), np.array([of[-1] for of in self.lines])

    def shades(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Grey levels (h, w) of samples at these places."""
        (i, a), (j, b) = (_between(of.astype(np.float32), at) for of, at in zip(self.lines, (x, y), strict=True))
        cells = self.cells.astype(np.float32)
        above = cells[j, i] * (1.0 - a) + cells[j, i + 1] * a
        below = cells[j + 1, i] * (1.0 - a) + cells[j + 1, i + 1] * a
        return np.asarray(above * (1.0 - b) + below * b)


@dataclass(frozen=True, eq=False)
class DotPrint(Print):
    """Black dots on white paper.

    Attributes:
        centres: (M, 2). [m]
        radius: of every dot. [m]
    """

    centres: Floats
    radius: float

    @property
    def paper(self) -> tuple[Floats, Floats]:
        """Lower and upper corner (2,) of the paper: four radii around the dots. [m]."""
        return self.centres.min(axis=0) - 4.0 * self.radius, self.centres.max(axis=0) + 4.0 * self.radius

    def shades(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Grey levels (h, w) of samples at these places."""
        from scipy.spatial import cKDTree

        places = np.stack([x.ravel(), y.ravel()], axis=1)
        near, _ = cKDTree(self.centres).query(np.nan_to_num(places, posinf=1e6, neginf=-1e6))
        ink = _share((self.radius - near).reshape(x.shape).astype(np.float32))
        (left, top), (right, bottom) = self.paper
        on_paper = (x > left) & (x < right) & (y > top) & (y < bottom)
        return np.where(on_paper, WHITE + (BLACK - WHITE) * ink, np.float32(WALL))


@dataclass(frozen=True, eq=False)
class Bulge:
    """How a piece of a target bulges because the target is not flat.

    Attributes:
        T_target_print: (4, 4) of the piece. [m]
        bends: (3,) of the target, along x, twisted, along y, at its rim. [m]
        middle: (2,) of the target. [m]
        half: of its longer side. [m]
    """

    T_target_print: Floats
    bends: Floats
    middle: Floats
    half: float

    def height(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
        """How far off the target's plane (h, w) the piece is at places of its own. [m]."""
        T, (a, b, c) = self.T_target_print, self.bends
        u, v = ((T[i, 0] * x + T[i, 1] * y + (T[i, 3] - self.middle[i])) / self.half for i in range(2))
        return np.asarray(a * u * u + b * u * v + c * v * v, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class PlacedPrint:
    """A piece of a print, placed in a frame: of the target, or of the camera that it is before.

    Attributes:
        T_frame_print: (4, 4), or (height, 4, 4) for each row of an image that a rolling shutter takes; of a print that
            is larger than it should be the axes are as much longer. [m]
        piece: what is printed.
        bulge: how it bulges; None where it is flat.
    """

    T_frame_print: Floats
    piece: Print
    bulge: Bulge | None = None

    def before(self, T_cam_frame: Floats) -> PlacedPrint:
        """Return the same of a piece that is placed in another frame, (4, 4) or (height, 4, 4) in the camera's. [m]."""
        return replace(self, T_frame_print=T_cam_frame @ self.T_frame_print)

    def at(self, rows: slice, repeats: int) -> Floats:
        """Return T_frame_print (1 or h, 4, 4) of some rows, each so many times."""
        T = self.T_frame_print
        return T[None] if T.ndim == 2 else np.repeat(T[rows], repeats, 0)

    def outline(self) -> Floats:
        """Return places (K, 3) along the paper's rim in the camera's frame, of each of its poses. [m]."""
        (left, top), (right, bottom) = self.piece.paper
        along = np.linspace(0.0, 1.0, 33)
        x, y = left + (right - left) * along, top + (bottom - top) * along
        edges = ((x, top), (x, bottom), (left, y), (right, y))
        places = np.concatenate([np.stack(np.broadcast_arrays(*edge, 0.0), axis=1) for edge in edges])
        if self.bulge is not None:
            places += self.bulge.height(places[:, 0], places[:, 1])[:, None] * self.bulge.T_target_print[2, :3]
        T = self.at(slice(None, None, max(len(self.T_frame_print) // 8, 1)), 1)
        result: Floats = (places @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]).reshape(-1, 3)
        return result

    def met(
        self, rays: NDArray[np.float32], rows: slice, repeats: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Where (x, y) on the print, and at which 1 / depth (negative behind the camera), rays (h, w, 2) meet it."""
        T = self.at(rows, repeats)
        # A point (x, y, 0) of the print is seen along H (x, y, 1); the last component is then 1 / depth.
        H = np.linalg.inv(T[:, :3, [0, 1, 3]]).astype(np.float32)[:, :, :, None]
        x, y, inverse_depth = (H[:, i, 0] * rays[..., 0] + H[:, i, 1] * rays[..., 1] + H[:, i, 2] for i in range(3))
        nearness = np.where(inverse_depth > 0.0, inverse_depth, np.float32(np.inf)).astype(np.float32)
        x, y = x / nearness, y / nearness
        if self.bulge is None:
            return x, y, inverse_depth
        # The same with the plane where the print was met, a few times: a bulge is a hundredth of the print at most.
        normal = np.cross(T[:, :3, 0], T[:, :3, 1])
        M = np.linalg.inv(np.stack([T[:, :3, 0], T[:, :3, 1], normal], axis=-1)).astype(np.float32)[..., None]
        up = (T[:, :3, :3] @ self.bulge.T_target_print[2, :3]).astype(np.float32)[..., None]
        t, n = T[:, :3, 3].astype(np.float32)[..., None], normal.astype(np.float32)[..., None]
        slope = n[:, 0] * rays[..., 0] + n[:, 1] * rays[..., 1] + n[:, 2]
        for _ in range(_MEETINGS):
            height = self.bulge.height(x, y)
            px, py, pz = (t[:, i] + up[:, i] * height for i in range(3))
            depth = (n[:, 0] * px + n[:, 1] * py + n[:, 2] * pz) / slope
            off = depth * rays[..., 0] - px, depth * rays[..., 1] - py, depth - pz
            x, y = (M[:, i, 0] * off[0] + M[:, i, 1] * off[1] + M[:, i, 2] * off[2] for i in range(2))
        return x, y, np.float32(1.0) / depth


def prints_of(pattern: Pattern) -> list[tuple[Floats, Print]]:
    """Return what is printed on a target: T_target_print (4, 4) and the print of each piece. [m].

    Raises:
        SessionError: a pattern of this kind is not printed.
    """
    if isinstance(pattern, ChessboardPattern):
        return [(np.eye(4), board_print(pattern.board))]
    if isinstance(pattern, TagsPattern):
        return [(_place(of.position, of.rpy), _tag_print(pattern, number)) for number, of in pattern.tags.items()]
    if isinstance(pattern, CirclesPattern):
        radius = _DOT * pattern.spacing * (np.sqrt(2.0) if pattern.asymmetric else 1.0)
        return [(np.eye(4), DotPrint(np.array(list(pattern.points.values()))[:, :2], radius))]
    raise SessionError(f"a target of kind {pattern.kind!r} has no picture", where="simulate")


def board_print(board: Board) -> GridPrint:
    """Draw a board with a white margin one square wide; its origin is the first inner corner."""
    across, down = (count + 1 for count in board.shape)
    marks, markers = np.zeros(0), {}
    white = 1
    if board.kind == "charuco":
        printed = board.to_opencv()
        dictionary = printed.getDictionary()
        side, modules = float(board.marker or 0.0) / board.square, dictionary.markerSize + 2
        marks = 0.5 * (1.0 - side) + side * np.arange(modules + 1) / modules
        white = 0 if board.legacy and down % 2 == 0 else 1
        cells = [(i, j) for j in range(down) for i in range(across) if (i + j) % 2 == white]
        markers = {
            cell: _modules(dictionary, number)
            for cell, number in zip(cells, np.ravel(printed.getIds()).tolist(), strict=True)
        }
    step = len(marks) + 1
    shades = np.full((down * step + 2, across * step + 2), WHITE)
    for j, i in np.ndindex(down, across):
        block = shades[1 + j * step : 1 + (j + 1) * step, 1 + i * step : 1 + (i + 1) * step]
        if (i + j) % 2 != white:
            block[:] = BLACK
        elif (i, j) in markers:
            block[1:-1, 1:-1] = markers[i, j]

    def ruled(squares: int) -> Floats:
        inner = (np.arange(squares)[:, None] + np.concatenate([[0.0], marks])).ravel()
        return board.square * (np.concatenate([[-1.0], inner, [squares, squares + 1.0]]) - 1.0)

    return GridPrint((ruled(across), ruled(down)), np.pad(shades, 1, constant_values=WALL))


def _tag_print(pattern: TagsPattern, number: int) -> GridPrint:
    """Draw a tag with a white margin two modules wide; its origin is the centre."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, pattern.opencv))
    cells = _modules(dictionary, number)
    module = pattern.size / len(cells)
    middle = 0.5 * len(cells)
    lines: Floats = module * np.array([-middle - 2.0, *(np.arange(len(cells) + 1) - middle), middle + 2.0])
    return GridPrint((lines, lines), np.pad(np.pad(cells, 1, constant_values=WHITE), 1, constant_values=WALL))


def _modules(dictionary: Any, number: int) -> Floats:
    """Grey levels (n, n) of a marker's modules, its black border included."""
    import cv2

    side = dictionary.markerSize + 2
    return np.where(cv2.aruco.generateImageMarker(dictionary, number, side) > 0, WHITE, BLACK)


@dataclass(frozen=True)
class PrintRenderer:
    """Renders prints through one camera's lens.

    Every pixel is the mean of ``oversampling``^2 samples, and every sample is the exact mean over its own area
    where it meets one edge, so an edge is in place to better than a thousandth of a pixel.

    Attributes:
        camera: the camera.
        oversampling: samples along a pixel's side.
    """

    camera: Camera
    oversampling: int = 2

    def expected(
        self, prints: Sequence[PlacedPrint], blur: float = 0.8, smear: tuple[float, float] = (0.0, 0.0)
    ) -> NDArray[np.float32]:
        """Compute the image without noise.

        Args:
            prints: what is before the camera; a nearer piece hides what is behind it.
            blur: standard deviation of the point spread. [px]
            smear: way of the image during the exposure. [px]

        Returns:
            (height, width) grey levels.
        """
        import cv2

        width, height = self.camera.resolution
        image = np.full((height, width), WALL, dtype=np.float32)
        reach = int(np.ceil(5.0 * blur + np.hypot(*smear))) + 2
        windows = [self._window(shown, reach) for shown in prints]
        if not windows:
            return image
        low, high = np.min([of[0] for of in windows], axis=0), np.max([of[1] for of in windows], axis=0)
        if np.any(high <= low):
            return image
        patch = self._sampled(prints, low, high)
        if blur > 0.0:
            patch = cv2.GaussianBlur(patch, (0, 0), blur * self.oversampling, borderType=cv2.BORDER_REPLICATE)
        if any(smear):
            patch = cv2.filter2D(patch, -1, self._smearing(smear), borderType=cv2.BORDER_REPLICATE)
        image[low[1] : high[1], low[0] : high[0]] = cv2.resize(patch, high - low, interpolation=cv2.INTER_AREA)
        return image

    def _smearing(self, smear: tuple[float, float]) -> NDArray[np.float32]:
        """The kernel of a straight motion, in samples."""
        way = self.oversampling * np.array(smear)
        middle = int(np.ceil(0.5 * np.abs(way).max())) + 1
        kernel = np.zeros((2 * middle + 1, 2 * middle + 1), dtype=np.float32)
        parts = np.linspace(-0.5, 0.5, 16 * middle)
        for x, y in np.rint(middle + parts[:, None] * way).astype(int):
            kernel[y, x] += 1.0 / len(parts)
        return kernel

    def _window(self, shown: PlacedPrint, reach: int) -> tuple[Ints, Ints]:
        """First and last pixel (u, v) that the paper can be in, and ``reach`` px around them."""
        uv = self.camera.project(shown.outline())
        size = np.array(self.camera.resolution)
        if np.isnan(uv).any():
            return np.zeros(2, dtype=np.intp), size
        low = np.clip(np.floor(uv.min(axis=0)).astype(np.intp) - reach, 0, size)
        return low, np.clip(np.ceil(uv.max(axis=0)).astype(np.intp) + reach, low, size)

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

    def _sampled(self, prints: Sequence[PlacedPrint], low: Ints, high: Ints) -> NDArray[np.float32]:
        """The part of the image before any blur, at the samples."""
        first, last = self.oversampling * low, self.oversampling * high
        rays = self._rays[first[1] : last[1], first[0] : last[0]]
        values = np.full(rays.shape[:2], WALL, dtype=np.float32)
        nearest = np.zeros(rays.shape[:2], dtype=np.float32)
        for shown in prints:
            x, y, inverse_depth = shown.met(rays, slice(low[1], high[1]), self.oversampling)
            (left, top), (right, bottom) = shown.piece.paper
            inside = (inverse_depth > nearest) & (x > left) & (x < right) & (y > top) & (y < bottom)
            values = np.where(inside, shown.piece.shades(x, y), values)
            nearest = np.where(inside, inverse_depth, nearest)
        return values


def _between(lines: NDArray[np.float32], x: NDArray[np.float32]) -> tuple[Ints, NDArray[np.float32]]:
    """For every sample, the cell before its nearest line, and the share of the sample that lies after that line."""
    nearest = np.clip(np.searchsorted(0.5 * (lines[1:] + lines[:-1]), x), 0, len(lines) - 1)
    return nearest, _share(x - lines[nearest], x)


def _share(beyond: NDArray[np.float32], x: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """The share (h, w) of each sample that lies beyond an edge, from its signed distance and what that is a part of."""
    down, across = np.gradient(beyond if x is None else x)
    steepness = np.sqrt(down * down + across * across)
    return np.asarray(np.clip(0.5 + beyond / np.maximum(steepness, np.float32(1e-30)), 0.0, 1.0))


def _place(position: Floats, rpy: Floats) -> Floats:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rpy_to_matrix(rpy), position
    return T
