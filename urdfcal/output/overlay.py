"""One pose of a recording as an image: what the cameras saw, and the arm drawn into it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.files import write_bytes
from urdfcal.output.photographs import decompressed
from urdfcal.output.projection import draw_image
from urdfcal.output.stream import CORNER, POSE

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from urdfcal.arrays import Floats

_GAP = 8
_ARMS = (("nominal", "arm/nominal"), ("calibrated", "arm/calibrated"))
_LEDS = (("detected", "sighted"), ("nominal", "nominal"), ("calibrated", "predicted"))


def write_overlay(path: Path, recording: Path, pose: str) -> None:
    """Draw the arm, nominal and calibrated, and the LEDs into every camera's image at a pose; write a PNG.

    Args:
        path: the PNG; replaced in one step.
        recording: ``calibration.rrd``.
        pose: its label.

    Raises:
        OutputError: there is no such pose, or no camera.
    """
    import cv2

    images = overlays(recording, pose)
    height = max(image.shape[0] for image in images.values())
    parts = [np.pad(image, ((0, height - len(image)), (0, _GAP), (0, 0))) for image in images.values()]
    done, data = cv2.imencode(".png", np.hstack(parts)[:, :-_GAP])
    if not done:
        raise OutputError("OpenCV cannot encode this image", where=str(path))
    write_bytes(path, data.tobytes())


def overlays(recording: Path, pose: str) -> dict[str, NDArray[np.uint8]]:
    """The images of :func:`write_overlay`, (h, w, 3) blue first, by camera.

    Raises:
        OutputError: there is no such pose, or no camera.
    """
    found = _Recorded(recording)
    poses = [str(label) for label in found.fixed("/base/texts/poses", "poses") or []]
    if pose not in poses:
        shown = ", ".join(poses[:5]) + (", ..." if len(poses) > 5 else "")
        raise OutputError(f"there is no pose {pose!r}", where=str(recording), remedy=f"There are: {shown}.")
    images = sorted(entity for entity in found.entities if entity.endswith("/image") and "/cameras/" in entity)
    if not images:
        raise OutputError(
            "no camera took part", where=str(recording), remedy="A tracker's points have no images to draw into."
        )
    at = poses.index(pose)
    return {image.split("/")[-2].replace("\\", ""): _overlay(found, image, at) for image in images}


def _overlay(found: _Recorded, image: str, at: int) -> NDArray[np.uint8]:
    width, height = (int(side) for side in (found.fixed(image, "Pinhole:resolution") or [[0, 0]])[0])
    photograph = found.row(image, "EncodedImage:blob", at)
    background = decompressed(bytes(photograph[0])) if photograph else (width, height)
    lines = [
        (kind, _pixels(strip))
        for kind, name in _ARMS
        for strip in found.row(f"{image}/{name}", "LineStrips2D:strips", at)
    ]
    leds = [(kind, _pixels(found.row(f"{image}/{name}", "Points2D:positions", at))) for kind, name in _LEDS]
    return draw_image(background, lines, leds)


def _pixels(values: Any) -> Floats:
    return np.asarray(values, dtype=float).reshape(-1, 2) - CORNER


class _Recorded:
    """The columns of a recording, by entity and component."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        self._columns: dict[tuple[str, str], tuple[Any, Any]] = {}
        try:
            chunks = list(RrdReader(path).stream())
        except RuntimeError as error:
            raise OutputError(
                "the recording cannot be read: it is damaged", where=str(path), remedy="Calibrate again."
            ) from error
        for chunk in chunks:
            if "/cameras/" not in chunk.entity_path and "/texts/" not in chunk.entity_path:
                continue
            batch = chunk.to_record_batch()
            times = None if chunk.is_static else batch.column(POSE) if POSE in batch.schema.names else None
            if chunk.is_static or times is not None:
                for name in batch.schema.names:
                    self._columns[chunk.entity_path, name] = (times, batch.column(name))

    @property
    def entities(self) -> set[str]:
        return {entity for entity, _ in self._columns}

    def fixed(self, entity: str, component: str) -> Any:
        """The value at all poses, or None."""
        times, column = self._columns.get((entity, component), (None, None))
        return column[0].as_py() if column is not None and times is None else None

    def row(self, entity: str, component: str, at: int) -> Any:
        """The instances at a pose; an empty list where there are none."""
        times, column = self._columns.get((entity, component), (None, None))
        if column is None or times is None or at not in (rows := times.to_pylist()):
            return []
        return column[rows.index(at)].as_py() or []
