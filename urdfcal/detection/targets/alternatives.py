"""What a picture shows instead of the target that a session names: other markers, another size."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

from urdfcal.cameras.board.detection import what_is_seen
from urdfcal.detection.targets.find import eight_bits, find_target
from urdfcal.detection.targets.tags import find_markers
from urdfcal.errors import SessionError
from urdfcal.session.pattern import ChessboardPattern, CirclesPattern, TagsPattern

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

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


def other_print(target: Target, images: Sequence[tuple[Camera, Image]]) -> str:
    """Say what is seen instead of a target, as the end of a sentence.

    Args:
        target: that is not found.
        images: some of those in which it should be, with their cameras.
    """
    pattern = target.pattern
    missed = [(camera, image) for camera, image in images if find_target(image, target, camera).reason]
    if isinstance(pattern, ChessboardPattern):
        said = Counter(what_is_seen(image, pattern.board) for _, image in missed)
        return f": {said.most_common(1)[0][0]}" if said else ""
    if isinstance(pattern, CirclesPattern):
        for other in _grids(pattern):
            named = replace(target, pattern=other)
            found = sum(not find_target(image, named, camera).reason for camera, image in missed)
            if 2 * found > len(missed):
                return f": {other.kind} of {other.size[0]} x {other.size[1]} are found; is it that?"
        return ""
    return _markers(pattern, missed) if isinstance(pattern, TagsPattern) else ""


def _markers(pattern: TagsPattern, images: Sequence[tuple[Camera, Image]]) -> str:
    """Name the markers that are seen."""
    seen: dict[str, Counter[int]] = {name: Counter() for name in (pattern.opencv, *_DICTIONARIES)}
    for _, image in images:
        grey = eight_bits(image)
        for name, numbers in seen.items():
            numbers.update(find_markers(grey, name).keys())
    best = max(seen, key=lambda name: (sum(seen[name].values()), name == pattern.opencv))
    if sum(seen[best].values()) < _CHANCE:
        return ": no markers of any dictionary are seen"
    asked = f"{_numbers(set(pattern.tags))} of {pattern.opencv} asked for"
    return f": markers {_numbers(set(seen[best]))} of {best} are seen, {asked}"


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
