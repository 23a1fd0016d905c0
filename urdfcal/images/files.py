"""Image files and videos as arrays: any depth, any number of channels, several at a time, a video in its order."""

from __future__ import annotations

import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar, get_args

import numpy as np

from urdfcal.errors import CameraError
from urdfcal.files import replacing

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Image: TypeAlias = NDArray[Any]
    # Reading one image may take time, and is done where it is needed; of a video only a few are in memory at a time.
    SequenceImage: TypeAlias = "ImageFile" | "VideoFrame"
    ImageSequence: TypeAlias = Sequence["ImageFile"] | "Video"

Colour: TypeAlias = Literal["any", "red", "green", "blue"]
COLOURS: tuple[Colour, ...] = get_args(Colour)
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv")

# Depths of sensors whose values are stored in 16 bits as they are.
_DEPTHS = (10, 12, 14, 16)
# Cameras that shift their values or clip early end at 65,520 or 250: several pixels share that value.
_ALMOST, _SHARED = 0.9, 3
# Compression moves clipped values by a count or two.
_CLIPPED = 0.99

_T = TypeVar("_T")
_R = TypeVar("_R")


def read_image(path: Path) -> Image:
    """Read an image file as it is, without rotation by EXIF: (h, w) or, red first, (h, w, 3); 8 or 16 bit.

    Raises:
        CameraError: it cannot be read, or its pixels are of another kind.
    """
    import cv2

    try:
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise CameraError(f"cannot be read: {error.strerror}", where=str(path)) from error
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        raise CameraError("this is no image, or a damaged one", where=str(path), remedy="PNG, JPEG and TIFF are read.")
    if image.dtype not in (np.uint8, np.uint16):
        raise CameraError(f"its pixels are {image.dtype}", where=str(path), remedy="8 and 16 bit images are read.")
    if image.ndim == 2:
        return np.asarray(image)
    if image.shape[2] < 3:
        return np.asarray(image[..., 0])
    # OpenCV puts blue first, and a mask last.
    return np.ascontiguousarray(image[..., 2::-1])


def write_image(path: Path, image: Image) -> None:
    """Write an 8 or 16 bit image, (h, w) or red first (h, w, 3), as PNG.

    Raises:
        CameraError: it cannot be encoded.
        OSError: it cannot be written.
    """
    import cv2

    # The fastest setting: noise does not compress, whatever is tried.
    data = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    done, encoded = cv2.imencode(".png", data, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise CameraError("this image cannot be encoded", where=str(path))
    path.write_bytes(encoded.tobytes())


def channel(image: Image, colour: Colour) -> NDArray[np.float32]:
    """One number a pixel, (h, w): the named colour's, or of any colour the mean of all."""
    import cv2

    if image.ndim == 2:
        return image.astype(np.float32)
    if colour == "any":
        return np.asarray(cv2.transform(image, np.full((1, 3), 1.0 / 3.0)).astype(np.float32))
    return image[..., COLOURS.index(colour) - 1].astype(np.float32)


def saturation(image: Image) -> float:
    """The value from which on a pixel may be clipped."""
    top = int(image.max())
    depths = (8,) if image.dtype == np.uint8 else _DEPTHS
    full = next(2**depth - 1 for depth in depths if top < 2**depth)
    if top >= _ALMOST * full and top < full and np.count_nonzero(image == top) >= _SHARED:
        full = top
    return float(_CLIPPED * full)


@dataclass(frozen=True)
class ImageFile:
    """An image file with the LED on.

    Attributes:
        path: of it.
        dark: an image from the same place with the LED off, to be subtracted.
    """

    path: Path
    dark: Path | None = None

    def lit(self, resolution: tuple[int, int]) -> Image:
        """Read it.

        Raises:
            CameraError: it cannot be read, or has another size than ``resolution`` (width, height).
        """
        return sized(read_image(self.path), resolution, str(self.path))

    def unlit(self, resolution: tuple[int, int]) -> Image | None:
        """Read the dark one, if there is one.

        Raises:
            CameraError: it cannot be read, or has another size than ``resolution`` (width, height).
        """
        return None if self.dark is None else sized(read_image(self.dark), resolution, str(self.dark))


def sized(image: Image, resolution: tuple[int, int], where: str) -> Image:
    """The image, if it has the size ``resolution`` (width, height).

    Raises:
        CameraError: it has another.
    """
    if image.shape[1::-1] != resolution:
        what = f"the image is {image.shape[1]} x {image.shape[0]} px, the camera {resolution[0]} x {resolution[1]}"
        remedy = "Give the camera's resolution in the camera file, at which it was calibrated."
        raise CameraError(what, where=where, remedy=remedy)
    return image


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


def workers() -> int:
    """Threads that are worth starting: one a core, of those this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return max(1, len(affinity(0)) if affinity else os.cpu_count() or 1)


def in_parallel(
    function: Callable[[_T], _R],
    items: Iterable[_T],
    threads: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> Iterator[_R]:
    """``map`` with threads, in order, that never runs more than two items a thread ahead of its reader.

    Decoding and filtering happen outside Python's lock, so threads are enough; memory is bounded by what
    2 x threads results take. ``progress`` is called with 1 for every result.
    """
    threads = threads or workers()
    with ThreadPoolExecutor(threads) as pool:
        waiting: deque[Any] = deque()

        def next_one() -> _R:
            result: _R = waiting.popleft().result()
            if progress:
                progress(1)
            return result

        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) >= 2 * threads:
                    yield next_one()
            while waiting:
                yield next_one()
        finally:
            for future in waiting:
                future.cancel()
