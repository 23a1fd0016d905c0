"""What a recording shows of a session's images and videos: a picture of each camera and pose that has one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import evenly
from urdfcal.errors import CameraError
from urdfcal.images.files import Video
from urdfcal.output.images import compressed, encoded, find_index, find_photographs
from urdfcal.session.moves import poses_of_camera

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.session.model import Session

# Of each camera's video; every frame as an image of its own would be a hundred times the video's size.
_FRAMES = 100


def find_pictures(session: Session) -> tuple[dict[int, bytes], ...]:
    """For each camera its pictures by pose, as JPEG: a session's images, or of its videos up to a hundred frames each.

    Every frame is there at its own pose alone: the arm moves on.
    """
    lens, films = session.rig.lens, _film_frames(session)
    found = []
    for c, (of, images) in enumerate(zip(lens, find_photographs(session), strict=True)):
        poses = sorted(images)
        pictures = dict(zip(poses, compressed(images[pose] for pose in poses), strict=True))
        mine = set(poses_of_camera(session, c).tolist()) if lens.count(of) > 1 else films.get(of, {}).keys()
        found.append(pictures | {pose: data for pose, data in films.get(of, {}).items() if pose in mine})
    return tuple(found)


def _film_frames(session: Session) -> dict[int, dict[int, bytes]]:
    """Frames of each camera's video, by the camera's index."""
    index = find_index(session)
    if index is None:
        return {}
    films = [
        (c, poses, images)
        for pictures, of in (
            ([[shot.pose for shot in shots] for shots in index.shots], index.images),
            (index.pictures, index.picture_files),
        )
        for c, (poses, images) in enumerate(zip(pictures, of, strict=True))
        if isinstance(images, Video) and len(poses)
    ]

    def frames(film: tuple[int, Sequence[int], Video]) -> tuple[int, dict[int, bytes]]:
        c, poses, video = film
        some = evenly(np.arange(len(poses)), _FRAMES).tolist()
        thinned = replace(video, rows=tuple(video.rows[k] for k in some))
        try:
            pictures = [encoded(np.asarray(of.image[..., ::-1], dtype=np.uint8)) for of in thinned]
        except CameraError:  # no film of this session: nothing that a calibration from tables should fail for
            return c, {}
        return c, {poses[k]: picture for k, picture in zip(some, pictures, strict=True)}

    with ThreadPoolExecutor() as pool:
        return dict(pool.map(frames, films))
