"""The keys of a target in session.yaml and rig.yaml, by its kind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias, Union

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag

from urdfcal.errors import SessionError
from urdfcal.io.keys import Keys, Name, NotNegative, PlaceKeys, Positive, ScaleKeys, Vector
from urdfcal.io.yaml_document import Document
from urdfcal.session.pattern import PATTERNS, TagPlace
from urdfcal.session.target import Target

if TYPE_CHECKING:
    from pathlib import Path


class TargetKeys(PlaceKeys):
    """What every target has: its kind, its link (the tip link, if none is named), where there, and how surely."""

    kind: str
    link: Name | None = None
    sigma: tuple[NotNegative, NotNegative] | None = Field(default=None, strict=False)
    scale: ScaleKeys | None = None
    flatness: Positive | None = None

    def target(self, name: str, usual: ScaleKeys | None) -> Target:
        """The same in arrays, of the session's scale where it says none; other keys are its pattern's fields."""
        own = {key: getattr(self, key) for key in type(self).model_fields if key not in TargetKeys.model_fields}
        pattern = next(pattern for pattern in PATTERNS if pattern.kind == self.kind)
        sigma = None if self.sigma is None else np.repeat(self.sigma, 3)
        said = self.scale or usual
        scale = None if said is None else said.sigma
        try:
            return Target(name, pattern(**own), self.link, self.T, sigma, scale, self.flatness)
        except SessionError as error:
            raise SessionError(error.what, where=f"targets.{name}", remedy=error.remedy) from error


_Counts = Annotated[tuple[int, int], Field(strict=False)]


class ChessboardKeys(TargetKeys):
    """A chessboard: inner corners along x and y, and the side of a square in m."""

    kind: Literal["chessboard"]
    size: _Counts
    square: Positive


class CharucoKeys(TargetKeys):
    """A ChArUco board: squares along x and y, sides of a square and of a marker in m, OpenCV's dictionary."""

    kind: Literal["charuco"]
    size: _Counts
    square: Positive
    marker: Positive
    dictionary: Name
    legacy: bool = False


class CirclesKeys(TargetKeys):
    """A grid of dots: how many along x and y, and their spacing in m."""

    kind: Literal["circles", "acircles"]
    size: _Counts
    spacing: Positive


class TagPlaceKeys(PlaceKeys):
    """Where the centre of a tag is in its bundle, in m and rad."""


# "0:" with nothing behind it is a tag at the bundle's origin.
_Tags = dict[Name, Annotated[TagPlaceKeys, BeforeValidator(lambda value: {} if value is None else value)]]


def _by_number(tags: dict[str, TagPlaceKeys]) -> dict[int, TagPlace]:
    if wrong := [name for name in tags if not name.isdecimal()]:
        raise ValueError(f"{wrong[0]!r} is no number of a tag")
    return {int(name): TagPlace(**keys.model_dump(exclude_none=True)) for name, keys in tags.items()}


class ArucoKeys(TargetKeys):
    """ArUco markers: their side in m, OpenCV's dictionary, and where each is."""

    kind: Literal["aruco"]
    size: Positive
    tags: Annotated[_Tags, AfterValidator(_by_number)]
    dictionary: Name


class AprilTagKeys(TargetKeys):
    """AprilTags: their side in m, their family, and where each is."""

    kind: Literal["apriltag"]
    size: Positive
    tags: Annotated[_Tags, AfterValidator(_by_number)]
    family: Name


class DotsKeys(TargetKeys):
    """Points of any layout, in m."""

    kind: Literal["dots"]
    dots: Annotated[list[Vector], Field(min_length=1), AfterValidator(np.array)]


class FrameKeys(TargetKeys):
    """A body without points, whose pose is measured as a whole."""

    kind: Literal["frame"]


_KINDS = {
    "charuco": CharucoKeys,
    "chessboard": ChessboardKeys,
    "circles": CirclesKeys,
    "acircles": CirclesKeys,
    "apriltag": AprilTagKeys,
    "aruco": ArucoKeys,
    "dots": DotsKeys,
    "frame": FrameKeys,
}
if TYPE_CHECKING:
    AnyTargetKeys: TypeAlias = TargetKeys
else:
    AnyTargetKeys = Annotated[
        Union[tuple(Annotated[keys, Tag(f"[{kind}]")] for kind, keys in _KINDS.items())],  # noqa: UP007
        Discriminator(
            lambda value: f"[{value.get('kind')}]" if isinstance(value, dict) else None,
            custom_error_type="kind",
            custom_error_message=f"the key 'kind' is missing, or none of {', '.join(_KINDS)}",
        ),
    ]


class TargetsFile(Keys):
    """A file of targets alone."""

    targets: dict[Name, AnyTargetKeys]


def read_targets(path: Path) -> tuple[Target, ...]:
    """Read a YAML file whose key ``targets`` is that of session.yaml.

    Raises:
        SessionError: it cannot be read, or a target is not one, with line and column.
    """
    document = Document.read(path)
    keys = document.validate(TargetsFile)
    with document.placing():
        return tuple(target.target(name, None) for name, target in keys.targets.items())
