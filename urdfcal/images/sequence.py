"""Pictures of one camera, wherever they are: files, or a video."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from urdfcal.errors import CameraError
from urdfcal.images.files import read_image

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from urdfcal.images.files import Image


class Shown(Protocol):
    """One picture; reading it may take time, and is done where it is needed."""

    def lit(self, resolution: tuple[int, int]) -> Image:
        """The picture, which must be of the size ``resolution`` (width, height) in px."""

    def unlit(self, resolution: tuple[int, int]) -> Image | None:
        """One from the same place with the LED off, to be subtracted, if there is one."""


class Pictures(Protocol):
    """Many of them, in order: a list of files, or a video, of which only a few are in memory at a time."""

    def __len__(self) -> int:
        """How many."""

    def __iter__(self) -> Iterator[Shown]:
        """From the first to the last."""

    def __getitem__(self, index: int, /) -> Shown:
        """One of them."""


@dataclass(frozen=True)
class Picture:
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
        raise CameraError(
            f"the image is {image.shape[1]} x {image.shape[0]} px, the camera {resolution[0]} x {resolution[1]}",
            where=where,
            remedy="Give the camera's resolution in the camera file, at which it was calibrated.",
        )
    return image
