"""The cameras' images, where the session has them, small enough for a recording."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.session.moves import poses_of_camera, unmoved

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from urdfcal.session.model import Session

_FOLDER = "images"
# A 1.3-megapixel image takes about 100 kB then.
_QUALITY = 80


def find_photographs(session: Session) -> tuple[dict[int, Path], ...]:
    """For each camera the image of each pose, that of the first LED where several are lit one by one."""
    folder = session.folder / _FOLDER if session.folder is not None else None
    none: tuple[dict[int, Path], ...] = ({},) * len(session.attachments.camera)
    if folder is None or not folder.is_dir() or not none:
        return none
    from urdfcal.detection.image_index import read_index
    from urdfcal.images.files import Video

    try:
        index = read_index(folder, unmoved(session))
    except SessionError:  # a folder of other images: nothing that a calibration from tables should fail for
        return none
    # Videos stay where they are: every frame as an image of its own would be a hundred times their size.
    found: list[dict[int, Path]] = [
        {}
        if isinstance(images, Video)
        else {shot.pose: image.path for shot, image in reversed(list(zip(shots, images, strict=True)))}
        for shots, images in zip(index.shots, index.images, strict=True)
    ]
    lens = session.rig.lens
    seen = [set(poses_of_camera(session, c).tolist() if lens.count(of) > 1 else found[of]) for c, of in enumerate(lens)]
    return tuple({pose: found[of][pose] for pose in found[of] if pose in seen[c]} for c, of in enumerate(lens))


def compressed(paths: Iterable[Path]) -> list[bytes]:
    """Images as 8-bit JPEG, several at a time."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(_compressed, paths))


def _compressed(path: Path) -> bytes:
    import cv2

    image = cv2.imdecode(np.frombuffer(path.read_bytes(), dtype=np.uint8), cv2.IMREAD_ANYCOLOR)
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes() if done else b""


def decompressed(data: bytes) -> NDArray[np.uint8]:
    """An image from a recording, (h, w, 3), blue first."""
    import cv2

    return np.asarray(cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)
