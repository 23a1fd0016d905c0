"""The cameras' images: photographs, and the arm drawn by its joint values alone (Rossi, Savino et al., eq. 22)."""

from __future__ import annotations

import csv
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Floats, inverse
from urdfcal.errors import OutputError, SessionError
from urdfcal.files import write_bytes
from urdfcal.output.palette import MEASURED, OF_ARM
from urdfcal.output.placing import RobotPoses
from urdfcal.output.stream import CORNER, POSE
from urdfcal.session.moves import poses_of_camera, unmoved

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from urdfcal.detection.image_index import ImageIndex
    from urdfcal.estimation.snapshot import Snapshot
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session

# A lens bends straight lines: each is projected at so many points.
_POINTS = 5
# So many images aside nothing is drawn: next to the plane of the lens pixels go to 1e13, which no viewer can take.
_FARTHEST = 100.0
# Subpixel bits of OpenCV's drawing.
_SHIFT = 4
_COLORS = {name: color[::-1] for name, color in (OF_ARM | {"detected": MEASURED}).items()}
_FOLDER = "images"
# As in urdfcal.detection.detect, which takes long to import.
_REJECTED = "detections_rejected.csv"
# A 1.3-megapixel image takes about 100 kB then.
_QUALITY = 80
_GAP = 8
# Images darker than this on the average are shown with a gamma of 2.2.
_DARK = 50.0
_BRIGHTER = np.round(255.0 * (np.arange(256) / 255.0) ** (1 / 2.2)).astype(np.uint8)
_LEDS = (("detected", "sighted"), ("nominal", "nominal"), ("calibrated", "predicted"))


def arm_in_images(calibration: FittedCalibration, arm: Snapshot, q: Floats) -> list[Floats]:
    """The pixels of the arm's axes and common normals at given joint values, in each camera.

    Args:
        calibration: whose robot, base and cameras.
        arm: its calibrated arm, or the nominal one, placed to fit the measurements best.
        q: (N, n) joint values. [rad or m]

    Returns:
        (N, P, 2) for each camera: a line from the base over all DH rows to the tip, in px, bent by the lens; NaN behind
        the camera, and between the lines of an arm that branches.
    """
    poses, along = RobotPoses.of(calibration, arm, q), np.linspace(0.0, 1.0, _POINTS)[:-1, None]
    corners = skeleton(poses.rows.lines)
    points = (1 - along) * corners[:, :-1, None] + along * corners[:, 1:, None]
    points = np.concatenate([points.reshape(len(corners), -1, 3), corners[:, -1:]], axis=1)
    lines = []
    for camera, T in zip(arm.cameras, inverse(poses.T_base_cam), strict=True):
        uv: Floats = camera.project(points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3])
        uv[np.abs(uv).max(axis=-1) > _FARTHEST * max(camera.resolution)] = np.nan
        lines.append(uv)
    return lines


def skeleton(lines: Sequence[Floats]) -> Floats:
    """Corners of the arm's DH rows, (N, 2 n + 3, 3) in m in the base link's frame: base, F_0, foot, F_1, ..., tip.

    Of an arm that branches one such line (N, K, 3) after the other, NaN in between.
    """
    gap = np.full((len(lines[0]), 1, 3), np.nan)
    return np.concatenate([part for line in lines for part in (gap, line)][1:], axis=1)


def finite_pieces(uv: Floats) -> list[Floats]:
    """The stretches of a line (P, 2) that are in front of the camera."""
    ends = np.flatnonzero(np.diff(np.isfinite(uv).all(axis=1).astype(int))) + 1
    return [piece for piece in np.split(uv, ends) if len(piece) > 1 and np.isfinite(piece).all()]


def draw_image(
    image: NDArray[np.uint8], lines: Sequence[tuple[str, Floats]], leds: Sequence[tuple[str, Floats]]
) -> NDArray[np.uint8]:
    """Draw arms and LEDs over a camera's image.

    Args:
        image: (h, w, 3).
        lines: kind (``nominal`` or ``calibrated``) and (P, 2) pixels, NaN where there are none.
        leds: kind (``detected``, ``nominal`` or ``calibrated``) and (K, 2) pixels.

    Returns:
        (h, w, 3) blue, green, red, as OpenCV writes it.
    """
    import cv2

    canvas: NDArray[np.uint8] = image.copy()
    size = max(canvas.shape) / 1000
    thickness = max(1, round(2 * size))
    for kind, uv in lines:
        for piece in finite_pieces(uv):
            cv2.polylines(canvas, [_fixed_point(piece)], False, _COLORS[kind], thickness, cv2.LINE_AA, _SHIFT)
    for kind, uv in leds:
        for centre in _fixed_point(uv[np.isfinite(uv).all(axis=-1)]):
            radius = round((9 if kind == "detected" else 5) * size * 2**_SHIFT)
            cv2.circle(canvas, centre.tolist(), radius, _COLORS[kind], thickness, cv2.LINE_AA, _SHIFT)
    return canvas


def _fixed_point(uv: Floats) -> NDArray[np.int32]:
    # Far outside of the image OpenCV's integers would overflow.
    result: NDArray[np.int32] = np.round(np.clip(uv, -(2.0**15), 2.0**15) * 2**_SHIFT).astype(np.int32)
    return result


def find_photographs(session: Session) -> tuple[dict[int, Path], ...]:
    """For each camera the image of each pose: of its targets, or of the first LED where several are lit one by one."""
    found: list[dict[int, Path]] = [{} for _ in session.attachments.camera]
    for mine, by_led in zip(found, find_shots(session), strict=False):
        for (pose, _), path in by_led.items():
            mine.setdefault(pose, path)
    return tuple(found)


def find_shots(session: Session) -> tuple[dict[tuple[int, int], Path], ...]:
    """For each camera the image of each pose and LED, as an index of the session's; with -1 for the targets, first."""
    index = find_index(session)
    none: tuple[dict[tuple[int, int], Path], ...] = ({},) * len(session.attachments.camera)
    if index is None:
        return none
    from urdfcal.images.files import Video

    found: list[dict[tuple[int, int], Path]] = [{} for _ in index.shots]
    of_pictures = [[(pose, -1) for pose in poses] for poses in index.pictures]
    of_leds = [[(shot.pose, shot.led) for shot in shots] for shots in index.shots]
    for shots, files in ((of_pictures, index.picture_files), (of_leds, index.images)):
        for mine, of_camera, images in zip(found, shots, files, strict=True):
            if not isinstance(images, Video):
                mine.update((shot, image.path) for shot, image in zip(of_camera, images, strict=True))
    lens = session.rig.lens
    poses = [{pose for pose, _ in of} for of in found]
    seen = [set(poses_of_camera(session, c).tolist() if lens.count(of) > 1 else poses[of]) for c, of in enumerate(lens)]
    return tuple({shot: path for shot, path in found[of].items() if shot[0] in seen[c]} for c, of in enumerate(lens))


def find_index(session: Session) -> ImageIndex | None:
    """Which of a session's images shows what; None where there are none, or images of something else."""
    folder = session.folder / _FOLDER if session.folder is not None else None
    if folder is None or not folder.is_dir() or not len(session.attachments.camera):
        return None
    from urdfcal.detection.image_index import read_index

    try:
        return read_index(folder, unmoved(session))
    except SessionError:  # a folder of other images: nothing that a calibration from tables should fail for
        return None


def find_rejected(session: Session) -> dict[str, list[tuple[int, float, float, str]]]:
    """What `urdfcal detect` has rejected in a session's images, by camera: pose (its index), u, v in px, and why."""
    path = None if session.folder is None else session.folder / _REJECTED
    if path is None or not path.is_file():
        return {}
    index = {session.label(k): k for k in range(len(session.poses))}
    found: dict[str, list[tuple[int, float, float, str]]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            try:
                light = index[row["pose"]], float(row["u"]), float(row["v"]), row["reason"]
            except (KeyError, TypeError, ValueError):  # of a pose that does not count, or no light at all
                continue
            found.setdefault(row["camera"], []).append(light)
    return {camera: sorted(lights) for camera, lights in found.items()}


def compressed(paths: Iterable[Path]) -> list[bytes]:
    """Images as 8-bit JPEG, several at a time; dark ones brightened, lest the arm beside a bright LED is not seen."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(_compressed, paths))


def _compressed(path: Path) -> bytes:
    import cv2

    return encoded(cv2.imdecode(np.frombuffer(path.read_bytes(), dtype=np.uint8), cv2.IMREAD_ANYCOLOR))


def encoded(image: NDArray[np.uint8] | None) -> bytes:
    """An image (h, w[, 3], blue first) as JPEG, brightened if it is dark; nothing of none."""
    import cv2

    if image is None:
        return b""
    if image.mean() < _DARK:
        image = np.asarray(cv2.LUT(image, _BRIGHTER), dtype=np.uint8)
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes() if done else b""


def write_overlay(path: Path, recording: Path, pose: str) -> tuple[str, ...]:
    """Draw the arm, nominal and calibrated, and the LEDs into every camera's image at a pose; write a PNG.

    Args:
        path: the PNG; replaced in one step.
        recording: ``calibration.rrd``.
        pose: its label.

    Returns:
        The cameras of which there is no picture at this pose: there the ground is dark.

    Raises:
        OutputError: there is no such pose, or no camera.
    """
    import cv2

    images, without = overlays(recording, pose)
    height = max(image.shape[0] for image in images.values())
    parts = [np.pad(image, ((0, height - len(image)), (0, _GAP), (0, 0))) for image in images.values()]
    done, data = cv2.imencode(".png", np.hstack(parts)[:, :-_GAP])
    if not done:
        raise OutputError("OpenCV cannot encode this image", where=str(path))
    write_bytes(path, data.tobytes())
    return without


def overlays(recording: Path, pose: str) -> tuple[dict[str, NDArray[np.uint8]], tuple[str, ...]]:
    """The images of :func:`write_overlay`, (h, w, 3) blue first, by camera; and the cameras without a picture.

    Raises:
        OutputError: there is no such pose, or no camera.
    """
    import cv2

    found = _recorded(recording)

    def value(entity: str, component: str, at: int | None = None) -> Any:
        """The instances at a pose, or those of all poses; None where there are none."""
        scalar = found.get((entity, component), {}).get(at)
        return None if scalar is None else scalar.as_py()

    poses = [str(label) for label in value("/base/texts/poses", "poses") or []]
    # 1 is 01, where only one pose is called so.
    alike = [label for label in poses if label.lstrip("0") == pose.lstrip("0")]
    if pose not in poses and len(alike) == 1:
        pose = alike[0]
    if pose not in poses:
        shown = f"{', '.join(poses[:3])} to {poses[-1]}" if len(poses) > 3 else ", ".join(poses)
        raise OutputError(f"there is no pose {pose!r}", where=str(recording), remedy=f"There are {shown}.")
    images = sorted({entity for entity, _ in found if entity.endswith("/image") and "/cameras/" in entity})
    if not images:
        raise OutputError(
            "no camera took part", where=str(recording), remedy="A tracker's points have no images to draw into."
        )
    at, drawn, without = poses.index(pose) + 1, {}, []
    for image in images:
        camera = image.split("/")[-2].replace("\\", "")
        width, height = (int(side) for side in (value(image, "Pinhole:resolution") or [[0, 0]])[0])
        background = np.full((height, width, 3), 16, dtype=np.uint8)
        if photograph := value(image, "EncodedImage:blob", at):
            data = np.frombuffer(bytes(photograph[0]), dtype=np.uint8)
            background = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)
        else:
            without.append(camera)
        lines = [
            (kind, _pixels(strip))
            for kind in OF_ARM
            for strip in value(f"{image}/arm/{kind}", "LineStrips2D:strips", at) or []
        ]
        leds = [(kind, _pixels(value(f"{image}/{name}", "Points2D:positions", at) or [])) for kind, name in _LEDS]
        drawn[camera] = draw_image(background, lines, leds)
    return drawn, tuple(without)


def _pixels(values: Any) -> Floats:
    return np.asarray(values, dtype=float).reshape(-1, 2) - CORNER


def _recorded(path: Path) -> dict[tuple[str, str], dict[int | None, Any]]:
    """The columns of a recording by entity and component: a value by pose, or one at None for all poses."""
    from rerun.chunk import RrdReader

    columns: dict[tuple[str, str], dict[int | None, Any]] = {}
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
        if chunk.is_static or POSE in batch.schema.names:
            poses = [None] if chunk.is_static else batch.column(POSE).to_pylist()
            for name in batch.schema.names:
                columns[chunk.entity_path, name] = dict(zip(poses, batch.column(name), strict=True))
    return columns
