"""Calibration boards: chessboards and ChArUco boards, and the file that describes one."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np

from urdfcal.arrays import Floats, Ints, frozen
from urdfcal.cameras.io.entries import Entry, standing
from urdfcal.errors import CameraError

if TYPE_CHECKING:
    from pathlib import Path

BoardKind = Literal["chessboard", "charuco"]

# OpenCV finds no smaller board, and fewer corners do not tell a homography from noise.
_FEWEST = 3
# A printed square is between a few millimetres and half a metre; 25 is millimetres.
_LARGEST_SQUARE = 1.0
_METRES = "Lengths are in metres: 0.025, or 2.5e-2."
_KEYS = ("type", "columns", "rows", "square", "marker", "dictionary", "legacy", "measured")
_MEASURED = ("squares", "length", "sigma")
# Printers scale by up to 5 % to fit a page; a square more or less counted is 8 % and more.
_MOST_SCALED = 0.07


@dataclass(frozen=True)
class Board:
    """A flat board with black and white squares.

    The board's frame has its origin at the first inner corner, x along the columns, y along the rows and z
    into the board, so a camera that looks straight at it has nearly its orientation. The square up and left
    of the origin is black.

    Attributes:
        kind: "chessboard" or "charuco".
        columns: as OpenCV counts: inner corners along x of a chessboard, squares along x of a ChArUco board.
        rows: the same along y.
        square: side of a square, m.
        marker: side of the markers, black border included, m; ChArUco only.
        dictionary: OpenCV's name of the markers' dictionary, such as DICT_4X4_50; ChArUco only.
        scale_sigma: standard deviation of the share that the squares may be longer than said; None if nothing is known.
        legacy: printed by OpenCV before 4.6, where a ChArUco board with an even number of rows begins with a marker.

    Raises:
        CameraError: there is no such board.
    """

    kind: BoardKind
    columns: int
    rows: int
    square: float
    marker: float | None = None
    dictionary: str | None = None
    scale_sigma: float | None = None
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.kind not in get_args(BoardKind):
            raise CameraError(f"board type '{self.kind}' is not known", remedy="Use chessboard or charuco.")
        if min(self.shape) < _FEWEST:
            what = f"a {self.columns} x {self.rows} {self.kind} has {self.shape[0]} x {self.shape[1]} inner corners"
            raise CameraError(what, remedy=f"It needs at least {_FEWEST} x {_FEWEST}.")
        if not 0.0 < self.square < _LARGEST_SQUARE:
            raise CameraError(f"a square of {self.square:g} m is no board's", remedy="Give its side in metres.")
        if self.kind == "charuco":
            self._check_markers()
        elif self.marker is not None or self.dictionary is not None:
            raise CameraError("a chessboard has no markers", remedy="Leave marker and dictionary out.")

    def measured(self, squares: int, length: float, sigma: float) -> Board:
        """The board as it was printed: its lengths scaled to a measured one.

        Args:
            squares: how many squares the length is long.
            length: from the first edge to the last, m.
            sigma: its standard deviation, m; 0.2 mm with a good ruler.

        Raises:
            CameraError: no such length can be on this board.
        """
        remedy = "Count the squares along it; give both lengths in metres."
        if not 1 <= squares <= max(self.shape) + 1 or not length > 0.0 or not 0.0 <= sigma < length:
            what = f"{squares} squares of together {length:g} ± {sigma:g} m cannot be measured on a {self.title}"
            raise CameraError(what, remedy=remedy)
        factor = length / squares / self.square
        if abs(factor - 1.0) > _MOST_SCALED:
            off = f"{100 * (factor - 1.0):+.0f} %"
            what = f"{squares} squares of together {length:g} m are {off} off squares of {self.square:g} m"
            raise CameraError(what, remedy=remedy)
        marker = None if self.marker is None else factor * self.marker
        return replace(self, square=length / squares, marker=marker, scale_sigma=sigma / length)

    @property
    def shape(self) -> tuple[int, int]:
        """Inner corners along x and along y."""
        inside = 0 if self.kind == "chessboard" else 1
        return self.columns - inside, self.rows - inside

    @cached_property
    def corners(self) -> Floats:
        """(N, 3) inner corners in the board's frame, row by row, m."""
        across, down = self.shape
        x, y = np.meshgrid(np.arange(across), np.arange(down))
        return frozen(self.square * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))

    def at(self, T: Floats) -> Floats:
        """Corners (V, N, 3) of boards at ``T`` (V, 4, 4), m."""
        return np.asarray(self.corners @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3])

    @cached_property
    def symmetries(self) -> tuple[Ints, ...]:
        """Orders (N,) of the corners in which the board looks the same, the first being 0 ... N - 1.

        Turning a chessboard half around changes its colours only if one side has an even number of inner
        corners and the other an odd one.
        """
        across, down = self.shape
        grid = np.arange(across * down).reshape(down, across)
        if self.kind == "charuco" or (across + down) % 2:
            turns: tuple[int, ...] = (0,)
        elif across == down and across % 2 == 0:
            turns = (0, 1, 2, 3)
        else:
            turns = (0, 2)
        return tuple(frozen(np.rot90(grid, k).ravel(), np.intp) for k in turns)

    @property
    def title(self) -> str:
        """The board in a few words."""
        markers = f", {1e3 * self.marker:g} mm markers of {self.dictionary}" if self.marker is not None else ""
        return f"{self.kind} {self.columns} x {self.rows}, {1e3 * self.square:g} mm squares{markers}"

    def to_opencv(self) -> Any:
        """The ``cv2.aruco.CharucoBoard``; the squares with odd column + row hold its markers."""
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(self.dictionary)))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker or 0.0, dictionary)
        board.setLegacyPattern(self.legacy)
        return board

    def _check_markers(self) -> None:
        import cv2

        if self.marker is None or self.dictionary is None:
            remedy = "For example marker 0.018 (m) and dictionary DICT_4X4_50."
            raise CameraError("a ChArUco board needs the side of its markers and their dictionary", remedy=remedy)
        if not 0.0 < self.marker < self.square:
            what = f"markers of {self.marker:g} m do not fit into squares of {self.square:g} m"
            raise CameraError(what, remedy="Give both in metres.")
        names = sorted(name for name in dir(cv2.aruco) if re.fullmatch(r"DICT_[A-Z0-9_]+", name))
        if self.dictionary not in names:
            raise CameraError(f"dictionary '{self.dictionary}' is not known", remedy=f"OpenCV has: {', '.join(names)}.")
        # Compared with what the dictionary holds, since OpenCV reads past its end.
        held = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        if self.columns * self.rows // 2 > held:
            raise CameraError(
                f"a {self.columns} x {self.rows} board has {self.columns * self.rows // 2} markers, "
                f"{self.dictionary} holds {held}",
                remedy="Name the dictionary the board was printed with.",
            )


def read_board(path: Path) -> Board:
    """Read board.yaml: type, columns, rows, square, for ChArUco marker and dictionary, and what was measured on it.

    Raises:
        CameraError: the file cannot be read or describes no board.
    """
    entry = Entry.read(path, f"the keys {', '.join(_KEYS)}")
    entry.only(_KEYS, "a board")
    # "marker:" with nothing behind it is left out, too.
    given = [key for key, node in entry.fields.items() if node.tag != "tag:yaml.org,2002:null"]
    size = entry.whole("columns"), entry.whole("rows"), entry.number("square", _METRES)
    marker = entry.number("marker", _METRES) if "marker" in given else None
    dictionary = entry.text("dictionary") if "dictionary" in given else None
    legacy = entry.text("legacy") if "legacy" in given else "false"
    if legacy not in ("true", "false"):
        raise entry.error("legacy", f"legacy is '{legacy}', not true or false")
    with standing(str(path)):
        board = Board(cast("BoardKind", entry.text("type")), *size, marker, dictionary, legacy=legacy == "true")
        if "measured" not in given:
            return board
        inner = entry.inner("measured")
        inner.only(_MEASURED, "measured")
        return board.measured(inner.whole("squares"), inner.number("length", _METRES), inner.number("sigma", _METRES))
