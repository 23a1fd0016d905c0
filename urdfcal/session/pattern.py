"""What is printed on a target: the points that a camera finds on it, in the target's frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.arrays import Floats, Ints, ReadOnly, finite_array, frozen, keep
from urdfcal.cameras.board.board import Board
from urdfcal.errors import CameraError, SessionError
from urdfcal.rotations import rpy_to_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping

# A printed dot or tag is between millimetres and half a metre; 40 is millimetres.
_LARGEST = 1.0
_FAMILIES = ("tag16h5", "tag25h9", "tag36h10", "tag36h11")


class Pattern(ABC):
    """Named points of known layout; the fields of a kind are its keys in session.yaml.

    Flat patterns have x to the right, y down and z into the print, so that a camera that looks straight at one has
    nearly its orientation.

    Attributes:
        kind: the value of ``kind`` in session.yaml.
    """

    kind: ClassVar[str]

    @property
    @abstractmethod
    def points(self) -> Mapping[str, Floats]:
        """(3,) each point in the target's frame, by its name after the colon in detections.csv. [m]."""

    @property
    def symmetries(self) -> tuple[Ints, ...]:
        """Orders (M,) of the points in which a picture of it is the same, turned by a whole circle in equal steps."""
        return (np.arange(len(self.points)),)


@dataclass(frozen=True)
class ChessboardPattern(Pattern):
    """A chessboard; its points are the inner corners in OpenCV's order, the first one the origin.

    Attributes:
        size: inner corners along x and along y.
        square: side of a square. [m]
    """

    kind: ClassVar[str] = "chessboard"

    size: tuple[int, int]
    square: float

    def __post_init__(self) -> None:
        _ = self.board

    @cached_property
    def board(self) -> Board:
        """The board, as cameras are calibrated with."""
        try:
            return self._board()
        except CameraError as error:
            raise SessionError(error.what, where=self.kind, remedy=error.remedy) from error

    @property
    def symmetries(self) -> tuple[Ints, ...]:
        """Turned by half, where both sides are odd or both even; by a quarter where they are equal and even."""
        return self.board.symmetries

    def _board(self) -> Board:
        return Board("chessboard", *self.size, self.square)

    @cached_property
    def points(self) -> Mapping[str, Floats]:
        """The inner corners, by OpenCV's index."""
        return _counted(self.board.corners)


@dataclass(frozen=True)
class CharucoPattern(ChessboardPattern):
    """A ChArUco board; its points are the inner corners of the squares, the first one the origin.

    Attributes:
        size: squares along x and along y.
        marker: side of the markers, black border included. [m]
        dictionary: OpenCV's name of the markers' dictionary, such as DICT_6X6_250.
        legacy: printed as before OpenCV 4.6: of a board of an even number of rows the first square is white.
    """

    kind: ClassVar[str] = "charuco"

    marker: float
    dictionary: str
    legacy: bool = False

    def _board(self) -> Board:
        return Board("charuco", *self.size, self.square, self.marker, self.dictionary, legacy=self.legacy)


@dataclass(frozen=True)
class CirclesPattern(Pattern):
    """A grid of dots, counted row by row, the first one the origin.

    Attributes:
        size: dots along x and along y.
        spacing: between neighbours of a row; of an asymmetric grid half of that, the distance of its rows. [m]
    """

    kind: ClassVar[str] = "circles"
    asymmetric: ClassVar[bool] = False

    size: tuple[int, int]
    spacing: float

    def __post_init__(self) -> None:
        _length(self.spacing, "spacing", self.kind)
        if min(self.size) < 2:
            raise SessionError(f"a grid of {self.size[0]} x {self.size[1]} dots is a line", where=self.kind)

    @property
    def symmetries(self) -> tuple[Ints, ...]:
        """Turned by half, but for an asymmetric grid of an odd number of rows; by a quarter where sides are equal."""
        grid = np.arange(len(self.points)).reshape(self.size[::-1])
        if self.asymmetric:
            turns: tuple[int, ...] = (0,) if self.size[1] % 2 else (0, 2)
        else:
            turns = (0, 1, 2, 3) if self.size[0] == self.size[1] else (0, 2)
        return tuple(np.rot90(grid, k).ravel() for k in turns)

    @cached_property
    def points(self) -> Mapping[str, Floats]:
        """The dots' centres."""
        x, y = np.meshgrid(np.arange(self.size[0]), np.arange(self.size[1]))
        if self.asymmetric:  # every second row is shifted by half the distance of its dots
            x = 2 * x + y % 2
        return _counted(np.stack([self.spacing * x.ravel(), self.spacing * y.ravel(), np.zeros(x.size)], axis=1))


@dataclass(frozen=True)
class AsymmetricCirclesPattern(CirclesPattern):
    """A grid of dots whose every second row is shifted by half the distance of its dots."""

    kind: ClassVar[str] = "acircles"
    asymmetric: ClassVar[bool] = True


@dataclass(frozen=True, eq=False)
class TagPlace:
    """Where a tag of a bundle is: its centre and its orientation in the bundle's frame.

    Attributes:
        position: (3,). [m]
        rpy: (3,) roll, pitch and yaw. [rad]
    """

    position: Floats = field(default_factory=lambda: np.zeros(3))
    rpy: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        keep(self, **{name: finite_array(getattr(self, name), (3,), name, "tag") for name in ("position", "rpy")})


@dataclass(frozen=True, eq=False)
class TagsPattern(Pattern):
    """One or several square markers; a marker's points are its corners, clockwise from the top left.

    Attributes:
        size: side of a marker, black border included. [m]
        tags: where each is, by its number.
    """

    size: float
    tags: Mapping[int, TagPlace]

    def __post_init__(self) -> None:
        import cv2

        _length(self.size, "size", self.kind)
        keep(self, tags=ReadOnly({int(number): place for number, place in self.tags.items()}))
        if not self.tags:
            raise SessionError("it names no tag", where=self.kind, remedy="Write for example tags: {0: {}}.")
        if self.opencv not in dir(cv2.aruco):
            names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
            raise SessionError(f"there is no dictionary {self.opencv!r}", remedy=f"OpenCV has: {', '.join(names)}.")
        held = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.opencv)).bytesList)
        for number in self.tags:
            if not 0 <= number < held:
                raise SessionError(f"there is no tag {number}: its dictionary holds 0 to {held - 1}", where=self.kind)

    @property
    @abstractmethod
    def opencv(self) -> str:
        """OpenCV's name of the markers' dictionary."""

    @cached_property
    def points(self) -> Mapping[str, Floats]:
        """The corners of every tag, such as 3.0 to 3.3."""
        square = 0.5 * self.size * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        return ReadOnly(
            {
                f"{number}.{corner}": frozen(rpy_to_matrix(place.rpy) @ p + place.position)
                for number, place in self.tags.items()
                for corner, p in enumerate(square)
            }
        )


@dataclass(frozen=True, eq=False)
class ArucoPattern(TagsPattern):
    """ArUco markers.

    Attributes:
        dictionary: OpenCV's name, such as DICT_4X4_50.
    """

    kind: ClassVar[str] = "aruco"

    dictionary: str

    @property
    def opencv(self) -> str:
        """OpenCV's name of the markers' dictionary."""
        return self.dictionary


@dataclass(frozen=True, eq=False)
class AprilTagPattern(TagsPattern):
    """AprilTags.

    Attributes:
        family: such as tag36h11.
    """

    kind: ClassVar[str] = "apriltag"

    family: str

    def __post_init__(self) -> None:
        if self.family not in _FAMILIES:
            remedy = f"OpenCV finds {', '.join(_FAMILIES)}."
            raise SessionError(f"family is {self.family!r}", where=self.kind, remedy=remedy)
        super().__post_init__()

    @property
    def opencv(self) -> str:
        """OpenCV's name of the family."""
        return f"DICT_APRILTAG_{self.family.removeprefix('tag')}"


@dataclass(frozen=True, eq=False)
class DotsPattern(Pattern):
    """Points of any layout, as the markers of a tracker's rigid body.

    Attributes:
        dots: (M, 3). [m]
    """

    kind: ClassVar[str] = "dots"

    dots: Floats

    def __post_init__(self) -> None:
        keep(self, dots=finite_array(self.dots, (len(self.dots), 3), "dots", self.kind))

    @cached_property
    def points(self) -> Mapping[str, Floats]:
        """The dots, by their place in the list."""
        return _counted(self.dots)


@dataclass(frozen=True)
class FramePattern(Pattern):
    """No points: a body whose pose is measured as a whole, as by a tracker's 6-D probe."""

    kind: ClassVar[str] = "frame"

    @property
    def points(self) -> Mapping[str, Floats]:
        """None."""
        return {}


PATTERNS: tuple[type[Pattern], ...] = (
    CharucoPattern,
    ChessboardPattern,
    CirclesPattern,
    AsymmetricCirclesPattern,
    AprilTagPattern,
    ArucoPattern,
    DotsPattern,
    FramePattern,
)
"""What a target may be."""


def _counted(points: Floats) -> Mapping[str, Floats]:
    return ReadOnly({str(k): frozen(p) for k, p in enumerate(points)})


def _length(value: float, name: str, where: str) -> None:
    if not 0.0 < value < _LARGEST:
        raise SessionError(f"{name} is {value:g} m", where=where, remedy="Lengths are in metres: 0.025, or 2.5e-2.")
