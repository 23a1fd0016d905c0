"""Videos: decoded from the first frame to the last, one at a time."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from urdfcal.errors import CameraError
from urdfcal.files import replacing
from urdfcal.images.files import sized

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from urdfcal.images.files import Image, ImageFile

    # Reading one image may take time, and is done where it is needed; of a video only a few are in memory at a time.
    SequenceImage: TypeAlias = ImageFile | "VideoFrame"
    ImageSequence: TypeAlias = Sequence[ImageFile] | "Video"

SUFFIXES = (".mp4", ".avi", ".mkv")


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """An image of a video, decoded.

    Attributes:
        image: (h, w, 3) red first, 8 bit.
        where: the video, and which of its images.
    """

    image: Image
    where: str

    def lit(self, resolution: tuple[int, int]) -> Image:
        """The image.

        Raises:
            CameraError: it has another size than ``resolution`` (width, height).
        """
        return sized(self.image, resolution, self.where)

    def unlit(self, resolution: tuple[int, int]) -> None:
        """A video has no dark images."""
        del resolution


@dataclass(frozen=True)
class Video:
    """Some images of a video file.

    Attributes:
        path: the file.
        rows: the images, from 0, in ascending order.
        count: how many images the file must have in all.
    """

    path: Path
    rows: tuple[int, ...]
    count: int

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[VideoFrame]:
        """Decode from the first to the last; the others are passed over.

        Raises:
            CameraError: the file cannot be read, or has another number of images.
        """
        wanted = set(self.rows)
        with _opened(self.path) as video:
            for row in range(self.count):
                if not video.grab():
                    raise self._miscounted(row)
                if row in wanted:
                    yield self._retrieved(video, row)
            if more := _rest(video):
                raise self._miscounted(self.count + more)

    def __getitem__(self, index: int) -> VideoFrame:
        """Decode one; where the file has no index it may be a neighbour.

        Raises:
            CameraError: the file cannot be read, or has fewer images.
        """
        import cv2

        with _opened(self.path) as video:
            video.set(cv2.CAP_PROP_POS_FRAMES, self.rows[index])
            if video.grab():
                return self._retrieved(video, self.rows[index])
        with _opened(self.path) as video:
            raise self._miscounted(_rest(video))

    def _retrieved(self, video: Any, row: int) -> VideoFrame:
        done, image = video.retrieve()
        if not done:
            raise CameraError("an image is damaged", where=f"{self.path}, image {row + 1}")
        return VideoFrame(np.ascontiguousarray(image[..., ::-1]), f"{self.path}, image {row + 1}")

    def _miscounted(self, found: int) -> CameraError:
        what = f"the video has {found} images, and the table of frames {self.count} of this camera"
        remedy = "Every image has its row, in the same order; none may be lost or added in encoding."
        return CameraError(what, where=str(self.path), remedy=remedy)


def write_video(path: Path, images: Iterable[Image], resolution: tuple[int, int], rate: float) -> None:
    """Write 8-bit images, (h, w) or red first (h, w, 3), as MPEG-4.

    Args:
        path: the file, .mp4.
        images: one after the other.
        resolution: (width, height) of them. [px]
        rate: frames per second, for players.

    Raises:
        CameraError: this OpenCV cannot encode it.
        OutputError: the folder cannot be written.
    """
    import cv2

    with replacing(path) as temporary:
        writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), rate, resolution)
        if not writer.isOpened():
            raise CameraError("this installation of OpenCV writes no MPEG-4", where=str(path))
        try:
            for image in images:
                colours = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., ::-1]
                writer.write(np.ascontiguousarray(colours))
        finally:
            writer.release()


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import cv2

    video = cv2.VideoCapture(str(path))
    try:
        if not video.isOpened():
            raise CameraError("this is no video, or one that OpenCV cannot decode", where=str(path))
        # A camera file knows nothing of how a phone was held.
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield video
    finally:
        video.release()


def _rest(video: Any) -> int:
    """How many images follow."""
    return sum(1 for _ in iter(video.grab, False))
