"""From a session's images to the points of its targets, and what is seen where they are not."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import evenly
from urdfcal.detection.targets.alternatives import another_board, other_print
from urdfcal.detection.targets.find import Found, find_target
from urdfcal.detection.targets.turned import UNTOLD, View, is_guessed, readings
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.images.files import in_parallel

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from urdfcal.arrays import Floats, Ints
    from urdfcal.cameras.camera import Camera
    from urdfcal.detection.image_index import ImageIndex
    from urdfcal.images.files import Image, SequenceImage
    from urdfcal.session.model import Positions

# What calibration is told of the best corners: paper is not flat, and ink not sharp, to better. [px]
_LEAST_SIGMA = 5e-3
# A target that is found in less of the images may be another one; some images decide.
_RARE, _LOOKED_AT = 0.25, 6

REMEDY = "Write under targets what is on the pictures, or take out those that do not show what is written there."
"""What to do where pictures show another print than a session names."""


@dataclass(frozen=True, eq=False)
class TargetSightings:
    """What a session's images show of its targets.

    Attributes:
        detections: of their points; None if there are none.
        rejected: pose, camera, target and reason of every image in which one was not found.
        warnings: targets that are seldom found, and what is seen instead.
        images: how many were looked at.
        told: whether in place of each target that is seldom found another print was recognized.
    """

    detections: Detections | None
    rejected: tuple[tuple[str, str, str, str], ...]
    warnings: tuple[str, ...]
    images: int
    told: bool = False


def find_targets(
    positions: Positions, index: ImageIndex, progress: Callable[[int], object] | None = None
) -> TargetSightings:
    """Look for the targets in the images of an index that show them.

    Args:
        positions: the session without its measurements.
        index: its images.
        progress: called with the number of images looked at since the last call.

    Raises:
        SessionError: the points of a target that looks the same turned around cannot be told apart, or the first
            pictures that are looked at show another board.
        CameraError: an image cannot be read, or has another size than its camera.
    """
    targets, first = positions.targets, len(positions.leds)
    ends = first + np.cumsum([0, *(len(target.points) for target in targets)])
    _check_prints(positions, index)
    parts, rejected, images = [], [], 0
    seen: Counter[str] = Counter()
    views: list[list[tuple[View, Floats]]] = [[] for _ in targets]

    def look(task: tuple[Camera, SequenceImage]) -> list[Found]:
        camera, shown = task
        image = shown.lit(camera.resolution)
        return [find_target(image, target, camera) for target in targets]

    for c, camera in enumerate(positions.rig.cameras):
        files: Iterable[SequenceImage] = index.picture_files[c]
        found_in = in_parallel(look, ((camera, shown) for shown in files), progress=progress)
        for pose, found in zip(index.pictures[c], found_in, strict=True):
            images += 1
            for t, (target, of) in enumerate(zip(targets, found, strict=True)):
                if not target.point_names:
                    continue
                if of.reason:
                    rejected.append((positions.label(pose), camera.name, target.name, of.reason))
                    continue
                views[t].append((View(c, pose, of.uv), of.sigma))
    for t, (target, mine) in enumerate(zip(targets, views, strict=True)):
        orders = _orders(positions, t, [view for view, _ in mine])
        for (view, sigma), order in zip(mine, orders, strict=True):
            if order is None:
                label = positions.label(view.pose)
                rejected.append((label, positions.rig.names[view.camera], target.name, UNTOLD))
                continue
            seen[target.name] += 1
            uv, sigma = view.uv[order], sigma[order]
            points = np.flatnonzero(np.isfinite(uv[:, 0]))
            index_of = np.full(len(points), view.pose), np.full(len(points), view.camera), ends[t] + points
            parts.append((*index_of, uv[points], np.maximum(_LEAST_SIGMA, sigma[points])))
    detections = Detections(*(np.concatenate(column) for column in zip(*parts, strict=True))) if parts else None
    rare = [target for target in targets if target.point_names and seen[target.name] < _RARE * images]
    sample = list(_sample(positions, index)) if rare else []
    instead = {target.name: other_print(target, sample) for target in rare}
    warnings = [
        f"target {target.name!r} looks the same turned around: the base is taken to have turned by less than "
        f"{180 // len(target.pattern.symmetries)} degrees whenever it moved"
        for t, target in enumerate(targets)
        if seen[target.name] and is_guessed(positions, t)
    ]
    for name, other in instead.items():
        warnings.append(f"target {name!r} is found in {seen[name]} of {images} images{other.words}")
    told = bool(instead) and all(other.told for other in instead.values())
    return TargetSightings(detections, tuple(rejected), tuple(warnings), images, told)


def _check_prints(positions: Positions, index: ImageIndex) -> None:
    """Refuse targets that are all printed otherwise than is said, before every picture is searched in vain.

    Raises:
        SessionError: the first of some pictures, spread over all of them, show another board and none of the targets.
    """
    printed = [target for target in positions.targets if target.point_names]
    # With so few there is nothing to be gained.
    if positions.leds or not printed or sum(map(len, index.picture_files)) <= _LOOKED_AT:
        return
    said = []
    for target in printed:
        if not (other := another_board(target, _sample(positions, index))):
            return
        said.append(f"target {target.name!r} is in none of the images that were looked at: {other}")
    raise SessionError("; ".join(said), where="targets", remedy=REMEDY)


def _orders(positions: Positions, t: int, views: list[View]) -> Sequence[Ints | None]:
    """The order of a target's points in each view, None where it does not show.

    Raises:
        SessionError: it shows in none.
    """
    target = positions.targets[t]
    if len(target.pattern.symmetries) == 1:
        return [np.arange(len(target.points))] * len(views)
    orders = readings(positions, t, views)
    if views and not any(order is not None for order in orders):
        what = f"target {target.name!r} looks the same turned around, and the arm does not tell which way round it is"
        remedy = (
            "Are its link and the URDF right? Otherwise use a ChArUco board, a chessboard with one odd and one even "
            "number of corners, or an asymmetric grid of an odd number of rows."
        )
        raise SessionError(what, where=f"targets.{target.name}", remedy=remedy)
    return orders


def _sample(positions: Positions, index: ImageIndex) -> Iterator[tuple[Camera, Image]]:
    """Some pictures of each camera, spread over its own; the cameras take turns."""
    chosen = [
        (turn, c, k)
        for c, pictures in enumerate(index.picture_files)
        for turn, k in enumerate(evenly(np.arange(len(pictures)), _LOOKED_AT).tolist())
    ]
    for _, c, k in sorted(chosen):
        camera = positions.rig.cameras[c]
        yield camera, index.picture_files[c][k].lit(camera.resolution)
