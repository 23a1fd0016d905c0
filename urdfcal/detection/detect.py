"""From a session's images to its detections: a detection that is sure, or none."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.detection.association import LightCandidate, associate
from urdfcal.detection.debug_images import draw_points, draw_spots
from urdfcal.detection.held import Shown
from urdfcal.detection.image_index import ImageIndex, read_index
from urdfcal.detection.led_frames import frames_in_base, led_frames
from urdfcal.detection.spots.detector import fall_off, find_spots
from urdfcal.detection.targets.search import REMEDY, find_targets
from urdfcal.errors import OutputError, SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.files import staged
from urdfcal.images.files import Video, in_parallel, workers, write_image
from urdfcal.io.folder import IMAGES, detections_path, read_positions
from urdfcal.io.writing import write_measurements, write_table
from urdfcal.session.moves import BASE_LINK, moves_before

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from urdfcal.cameras.camera import Camera
    from urdfcal.detection.image_index import Shot
    from urdfcal.detection.spots.detector import Spots
    from urdfcal.detection.targets.search import TargetSightings
    from urdfcal.images.files import Colour, SequenceImage
    from urdfcal.session.model import Positions

REJECTED = "detections_rejected.csv"
# Images that are named for each reason; the table has them all.
_NAMED = 4

# What MPEG-4 does to a spot 3.5 px wide in the 2 kB that OpenCV's encoder spends on a frame: 0.06 px a coordinate, of
# which its images, smoothed as they are, show nothing. [px]
_COMPRESSED = 0.06
# A number of a reason, no name's part.
_NUMBER = re.compile(r"(?<![\w.:'])(\d+(?:\.\d+)?)(?![\w:'])")
# Spots that may be moved by this much in a way that does not average out are worth a word. [px]
_BLURRED = 0.03
# What calibration is told of the best detections: dust and uneven pixels are not in an image's own noise. [px]
_LEAST_SIGMA = 2e-3


@dataclass(frozen=True, eq=False)
class Detected:
    """What was found in a session's images.

    Attributes:
        positions: the session without its detections.
        index: the images.
        spots: the small lights of each camera; the good ones are the detections.
        targets: what was found of the targets.
        warnings: what could not be used to decide, and what is left over.
    """

    positions: Positions
    index: ImageIndex
    spots: tuple[Spots, ...]
    targets: TargetSightings
    warnings: tuple[str, ...]

    @property
    def detections(self) -> Detections:
        """The detections.

        Raises:
            SessionError: there is none.
        """
        if not self.found:
            remedy = f"What was seen instead: {self.summary()}."
            if self.targets.warnings:
                # Where another print was recognized, sharp pictures and their light are beside the point.
                told = self.targets.told and not self.positions.leds
                raise SessionError("; ".join(self.targets.warnings), remedy=REMEDY if told else remedy)
            raise SessionError(f"no LED was found in {self.index.count} images", remedy=remedy)
        parts = []
        for c, (shots, images, spots) in enumerate(zip(self.index.shots, self.index.images, self.spots, strict=True)):
            pose, led = np.array(shots, dtype=np.intp).reshape(-1, 2).T
            seen = spots[spots.good]
            sigma = seen.fits.sigma
            sigma = np.hypot(sigma, _COMPRESSED) if isinstance(images, Video) else np.maximum(_LEAST_SIGMA, sigma)
            parts.append((pose[seen.image], np.full(len(seen), c), led[seen.image], seen.fits.uv, sigma))
        if (points := self.targets.detections) is not None:
            parts.append((points.pose, points.camera, points.led, points.uv, points.sigma))
        return Detections(*(np.concatenate(values) for values in zip(*parts, strict=True)))

    @property
    def found(self) -> int:
        """Number of detections."""
        points = self.targets.detections
        return sum(int(spots.good.sum()) for spots in self.spots) + (0 if points is None else len(points))

    def rejected(self) -> Iterator[tuple[str, str, str, int | None, str]]:
        """Pose, camera, LED, row of its camera's spots (None: no light) and reason of every light rejected."""
        for name, shots, spots in zip(self.positions.rig.names, self.index.shots, self.spots, strict=True):
            ends = np.searchsorted(spots.image, np.arange(len(shots) + 1)).tolist()
            for shot, (start, end) in zip(shots, pairwise(ends), strict=True):
                labels = self.positions.label(shot.pose), name, self.positions.led_names[shot.led]
                for i in range(start, end):
                    if spots.reasons[i]:
                        yield (*labels, i, spots.reasons[i])
                if start == end:
                    yield (*labels, None, "no light at all")
        for *of, reason in self.targets.rejected:
            yield (*of, None, reason)  # type: ignore[misc]

    def summary(self) -> str:
        """How often which reason was given and in which images, most frequent first."""
        return count_reasons((f"{camera}/{pose}", reason) for pose, camera, *_, reason in self.rejected())


def count_reasons(rejected: Iterable[tuple[str, str]]) -> str:
    """How often which reason is given and for what, most frequent first; those that differ in numbers alone are one."""
    where: dict[tuple[str, ...], list[str]] = defaultdict(list)
    numbers: dict[tuple[str, ...], list[list[str]]] = defaultdict(list)
    for what, reason in rejected:
        parts = _NUMBER.split(reason)
        words = tuple(parts[::2])
        where[words].append(what)
        numbers[words].append(parts[1::2])
    said = []
    for words, places in sorted(where.items(), key=lambda of: -len(of[1])):
        ranges = [*(_range(of) for of in zip(*numbers[words], strict=True)), ""]
        named = list(dict.fromkeys(places))
        shown = ", ".join(named[:_NAMED]) + (" ..." if len(named) > _NAMED else "")
        said.append(f"{''.join(chain.from_iterable(zip(words, ranges, strict=True)))} ({len(places)}: {shown})")
    return "; ".join(said)


def _range(numbers: Sequence[str]) -> str:
    """The smallest and the largest, as they are written."""
    ordered = sorted(set(numbers), key=float)
    return ordered[0] if len(ordered) == 1 else f"{ordered[0]} to {ordered[-1]}"


def detect(folder: str | Path, colour: Colour = "any") -> Detected:
    """Look for the LEDs in all images of a session.

    Args:
        folder: the session's, or its YAML file.
        colour: of the LEDs; "any" if it is not known, or the images are grey.

    Raises:
        SessionError: the session is malformed, or has no images.
        CameraError: an image cannot be read, or has another size than its camera.
    """
    return detect_in(*open_images(folder), colour)


def open_images(path: str | Path) -> tuple[Positions, ImageIndex]:
    """Read a session without its detections, and which images there are.

    Args:
        path: the session's folder, or its YAML file.

    Raises:
        SessionError: the session is malformed, or has no images.
    """
    positions = read_positions(path)
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    return positions, read_index(folder / IMAGES, positions)


def detect_in(
    positions: Positions, index: ImageIndex, colour: Colour = "any", progress: Callable[[int], object] | None = None
) -> Detected:
    """Look for LEDs and targets in the images of an index; see :func:`detect`."""
    rig = positions.rig
    if not rig.cameras:
        raise SessionError("no cameras are named", remedy="Images need a camera file.")
    T_base_frame = frames_in_base(positions)
    shown = []
    for c, (camera, shots, images) in enumerate(zip(rig.cameras, index.shots, index.images, strict=True)):
        pose, led = np.array(shots, dtype=np.intp).reshape(-1, 2).T
        stretch = moves_before(positions, BASE_LINK, camera.name, *(each.name for each in positions.leds))[pose]
        shown.append(Shown(camera, images, led_frames(positions, T_base_frame, c, pose, led), stretch, colour))

    def look(of: Shown) -> Spots:
        threads = max(1, workers() // len(index.shots))
        return find_spots(of.images, of.camera.resolution, colour, of.frames.places, progress, threads)

    # A thread a camera: a video is decoded from its beginning to its end by one.
    found = list(in_parallel(look, shown, min(workers(), len(index.shots))))
    spots, warnings = [], []
    for camera, of, seen in zip(rig.cameras, shown, found, strict=True):
        if len(seen.still):
            listing = ", ".join(f"({u}, {v})" for u, v in seen.still)
            warnings.append(f"camera {camera.name!r}: small lights stand still and were left out: {listing}")
        judged, said = of.held(seen)
        spots.append(judged)
        warnings += said
        warnings += _blurred(camera, judged)
    spots, more = _agreeing(positions, index, spots)
    targets = find_targets(positions, index, progress)
    warnings += [*more, *targets.warnings]
    return Detected(positions, index, tuple(spots), targets, (*positions.warnings, *index.warnings, *warnings))


def write_detected(path: str | Path, detected: Detected, *, force: bool = False) -> list[Path]:
    """Write detections.csv and detections_rejected.csv into a session's folder; both or none.

    Args:
        path: the session's folder, or its YAML file.
        detected: what was found.
        force: write over detections that are there already.

    Returns:
        The files.

    Raises:
        OutputError: there are detections already, or the folder cannot be written.
        SessionError: no LED was found.
    """
    table = detections_path(path)
    if table.exists() and not force:
        raise OutputError("there are detections already", where=str(table), remedy="Use --force to write over them.")
    detections = detected.detections
    with staged(table.parent) as stage:
        write_measurements(stage / table.name, detected.positions, detections)
        header = ["pose", "camera", "led", "u", "v", "sigma", "peak", "width", "reason"]
        write_table(stage / REJECTED, header, zip(*_rejected_rows(detected), strict=True))
    return [table, table.with_name(REJECTED)]


def write_debug_images(
    folder: Path, detected: Detected, colour: Colour = "any", progress: Callable[[int], object] | None = None
) -> None:
    """Draw what was found in each image: ``folder``/<camera>/<image>.png.

    Args:
        folder: where to; made if need be, in a folder that exists.
        detected: what was found.
        colour: that was looked for.
        progress: called with the number of drawings made since the last call.

    Raises:
        OutputError: the folder cannot be written.
    """
    positions, rig = detected.positions, detected.positions.rig
    if not rig.cameras:
        return
    points = detected.targets.detections

    def draw_picture(task: tuple[int, int, SequenceImage]) -> None:
        c, pose, shown = task
        label, marks = positions.label(pose), []
        if points is not None:
            seen = np.flatnonzero((points.camera == c) & (points.pose == pose))
            marks = [(positions.led_names[points.led[i]], points.uv[i]) for i in seen]
        drawing = draw_points(shown.lit(rig.cameras[c].resolution), marks, f"{rig.names[c]}  pose {label}")
        write_image(stage / rig.names[c] / f"{label}.png", drawing)

    def pictures() -> Iterator[tuple[int, int, SequenceImage]]:
        for c, (poses, files) in enumerate(zip(detected.index.pictures, detected.index.picture_files, strict=True)):
            sequence: Iterable[SequenceImage] = files
            for pose, shown in zip(poses, sequence, strict=True):
                yield c, pose, shown

    def draw(task: tuple[Camera, Shot, SequenceImage, Spots]) -> None:
        camera, shot, shown, spots = task
        label, led = positions.label(shot.pose), positions.led_names[shot.led]
        title = f"{camera.name}  pose {label}  LED {led}"
        drawing = draw_spots(shown.lit(camera.resolution), colour, spots, title)
        several = len(positions.leds) > 1 or positions.targets
        name = f"{label}.{led}.png" if several else f"{label}.png"
        write_image(stage / camera.name / name, drawing)

    def tasks() -> Iterator[tuple[Camera, Shot, SequenceImage, Spots]]:
        index = detected.index
        for camera, shots, images, spots in zip(rig.cameras, index.shots, index.images, detected.spots, strict=True):
            sequence: Iterable[SequenceImage] = images
            for number, (shot, shown) in enumerate(zip(shots, sequence, strict=True)):
                yield camera, shot, shown, spots[spots.image == number]

    with staged(folder) as stage:
        for name in rig.names:
            (stage / name).mkdir()
        for _ in in_parallel(draw, tasks(), progress=progress):
            pass
        for _ in in_parallel(draw_picture, pictures(), progress=progress):
            pass


def _rejected_rows(detected: Detected) -> Iterator[tuple[str, ...]]:
    names = detected.positions.rig.names
    for pose, camera, led, row, reason in detected.rejected():
        numbers = [""] * 5
        if row is not None:
            fits = detected.spots[names.index(camera)].fits
            values = (*fits.uv[row], fits.sigma[row], fits.peak[row], fits.width[row])
            numbers = [f"{value:.4g}" if abs(value) < 1e3 else f"{value:.1f}" for value in values]
        yield (pose, camera, led, *(number.replace("nan", "") for number in numbers), reason)


def _blurred(camera: Camera, seen: Spots) -> list[str]:
    """Say where spots are so large that they cannot be measured to what their light would allow."""
    fits = seen.fits[seen.good]
    moved = fall_off(fits, camera.resolution)
    if not len(fits) or np.median(moved) < _BLURRED:
        return []
    width, px = float(np.median(fits.width)), float(np.median(moved))
    said = (
        f"camera {camera.name!r}: the LED's spots are {width:.0f} px wide (sigma): a lens that darkens towards the "
        f"corners moves them by {px:.2g} px (counted in their sigma), all alike, so that more images do not help. "
        "Focus, or use a smaller LED"
    )
    return [said]


def _agreeing(positions: Positions, index: ImageIndex, spots: list[Spots]) -> tuple[list[Spots], list[str]]:
    """Reject what the other cameras' rays do not meet, and all but one light an image."""
    groups: defaultdict[tuple[int, int], list[LightCandidate]] = defaultdict(list)
    for camera, (shots, seen) in enumerate(zip(index.shots, spots, strict=True)):
        flux = seen.fits.flux
        for i in np.flatnonzero(seen.good):
            shot = shots[seen.image[i]]
            groups[shot.pose, shot.led].append(LightCandidate(camera, int(i), seen.fits.uv[i], float(flux[i])))
    # Which cameras are no longer where the camera file says, in each pose.
    moved = [moves_before(positions, name) > 0 for name in positions.rig.names]
    alike: defaultdict[tuple[int, ...], list[list[LightCandidate]]] = defaultdict(list)
    for (pose, _), group in groups.items():
        alike[tuple(c for c, of in enumerate(moved) if of[pose])].append(group)
    reasons = [np.full(len(seen), "", dtype=object) for seen in spots]
    warnings: list[str] = []
    for elsewhere, together in alike.items():
        verdict, said = associate(positions.rig, together, elsewhere)
        warnings += said
        for (camera, row), reason in verdict.items():
            reasons[camera][row] = reason
    return [seen.rejected(of != "", of) for seen, of in zip(spots, reasons, strict=True)], warnings
