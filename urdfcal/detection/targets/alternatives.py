"""What a picture shows instead of the target that a session names: other markers, another size."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from urdfcal.cameras.board.detection import seen_instead
from urdfcal.detection.targets.find import eight_bits, find_target
from urdfcal.detection.targets.tags import find_markers
from urdfcal.errors import SessionError
from urdfcal.session.pattern import ChessboardPattern, CirclesPattern, TagsPattern

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from urdfcal.cameras.camera import Camera
    from urdfcal.images.files import Image
    from urdfcal.session.target import Target

# Every dictionary that OpenCV has is the beginning of one of these.
_DICTIONARIES = (
    "DICT_4X4_1000",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
)
# A single marker is a chance likeness.
_CHANCE = 2
# So many images that show the same other board leave no doubt of it; each takes seconds to be searched in vain.
_ENOUGH = 3


@dataclass(frozen=True)
class Instead:
    """What pictures show instead of a target.

    Attributes:
        words: the end of a sentence that says that the target is not found.
        told: whether another print was recognized, so that nothing else need be asked of the pictures.
    """

    words: str = ""
    told: bool = False


def other_print(target: Target, images: Sequence[tuple[Camera, Image]]) -> Instead:
    """Tell what is seen instead of a target.

    Args:
        target: that is not found.
        images: some of those in which it should be, with their cameras.
    """
    pattern = target.pattern
    missed = [(camera, image) for camera, image in images if find_target(image, target, camera).reason]
    if isinstance(pattern, ChessboardPattern):
        said = Counter(seen_instead(image, pattern.board) for _, image in missed)
        if not said:
            return Instead()
        seen = said.most_common(1)[0][0]
        return Instead(f": {seen.words}", told=bool(seen.other))
    if isinstance(pattern, CirclesPattern):
        for other in _grids(pattern):
            named = replace(target, pattern=other)
            found = sum(not find_target(image, named, camera).reason for camera, image in missed)
            if 2 * found > len(missed):
                return Instead(f": {other.kind} of {other.size[0]} x {other.size[1]} are found; is it that?", told=True)
        return Instead()
    return _markers(pattern, missed) if isinstance(pattern, TagsPattern) else Instead()


def another_board(target: Target, images: Iterable[tuple[Camera, Image]]) -> str:
    """Say which one board the first images show instead of a chessboard that is in none of them.

    Args:
        target: that is looked for; of other kinds than chessboards nothing is said, their search takes no time.
        images: with their cameras; no more are read than are needed.

    Returns:
        What was found and what was asked for; empty if an image shows the target, or too few the same other one.
    """
    pattern, others = target.pattern, Counter[str]()
    if not isinstance(pattern, ChessboardPattern) or pattern.kind != "chessboard":
        return ""
    for camera, image in images:
        if not find_target(image, target, camera).reason:
            return ""
        seen = seen_instead(image, pattern.board)
        # Nothing that is recognized speaks for nothing: a board may be out of view, or cut.
        others.update([seen.other] if seen.other else [])
        if len(others) > 1:  # cut differently, or what stands around
            return ""
        if others[seen.other] == _ENOUGH:
            return seen.words
    return ""


def _markers(pattern: TagsPattern, images: Sequence[tuple[Camera, Image]]) -> Instead:
    """Name the markers that are seen."""
    seen: dict[str, Counter[int]] = {name: Counter() for name in (pattern.opencv, *_DICTIONARIES)}
    for _, image in images:
        grey = eight_bits(image)
        for name, numbers in seen.items():
            numbers.update(find_markers(grey, name).keys())
    best = max(seen, key=lambda name: (sum(seen[name].values()), name == pattern.opencv))
    if sum(seen[best].values()) < _CHANCE:
        return Instead(": no markers of any dictionary are seen")
    asked = f"{_numbers(set(pattern.tags))} of {pattern.opencv} asked for"
    # Those that were asked for and are seen nevertheless may be too small or too soft.
    told = best != pattern.opencv or not set(seen[best]) & set(pattern.tags)
    return Instead(f": markers {_numbers(set(seen[best]))} of {best} are seen, {asked}", told)


def _numbers(numbers: set[int]) -> str:
    ordered = sorted(numbers)
    return ", ".join(map(str, ordered[:12])) + (" ..." if len(ordered) > 12 else "")


def _grids(pattern: CirclesPattern) -> Iterator[CirclesPattern]:
    """Sizes that people mistake a grid's for."""
    across, down = pattern.size
    for size in ((down, across), *((across + i, down + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j)):
        try:
            yield replace(pattern, size=size)
        except SessionError:  # none that there is
            continue
