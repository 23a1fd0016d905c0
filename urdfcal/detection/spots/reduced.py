"""Images at a fraction of their resolution, in which a large spot is as small as others are at the full one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.images.files import saturation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from urdfcal.arrays import Bools
    from urdfcal.detection.spots.centroid import Fits
    from urdfcal.images.files import Image

# What 8 bits become, so that means of pixels are not rounded off.
_SCALE = 16


def reduced(image: Image, factor: int) -> Image:
    """The image at a ``factor``-th of its resolution, each pixel the mean of ``factor``²; a rest is cut off.

    Of 8 bits it has 12 then.
    """
    import cv2

    if factor == 1:
        return image
    whole, (width, height) = _whole(image, factor)
    means = cv2.resize(whole.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(np.rint(means * (_SCALE if image.dtype == np.uint8 else 1)).astype(np.uint16))


def clipped(image: Image, factor: int) -> Bools:
    """Which pixels (h, w) or (h, w, 3) of the reduced image are made of one that may be clipped.

    Such a mean is a lower bound, as a clipped pixel is: taken for the end of the range, a rim that is clipped in part
    would make spots too wide, and what is claimed of them 1.4 times too good.
    """
    full = np.asarray(image >= saturation(image))
    if factor == 1:
        return full
    whole, (width, height) = _whole(full, factor)
    return np.asarray(whole.reshape(height, factor, width, factor, *image.shape[2:]).any(axis=(1, 3)))


def _whole(image: NDArray[Any], factor: int) -> tuple[NDArray[Any], tuple[int, int]]:
    """The image without a rest, and the width and height of what it is reduced to."""
    height, width = (size // factor for size in image.shape[:2])
    return image[: height * factor, : width * factor], (width, height)


def enlarged(fits: Fits, factor: int) -> Fits:
    """What was measured in images reduced by a ``factor``, in pixels of the full resolution."""
    return replace(
        fits,
        uv=(fits.uv + 0.5) * factor - 0.5,
        sigma=fits.sigma * factor,
        width=fits.width * factor,
        saturated=fits.saturated * factor**2,
    )
