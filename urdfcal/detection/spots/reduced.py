"""Images at a fraction of their resolution, in which a large spot is as small as others are at the full one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.images.files import saturation

if TYPE_CHECKING:
    from urdfcal.detection.spots.centroid import Fits
    from urdfcal.images.files import Image

# What 8 bits become, so that means of pixels are not rounded off: 255 is then this, the end of 12 bits.
_SCALE, _FULL = 16, 4095


def reduced(image: Image, factor: int) -> Image:
    """The image at a ``factor``-th of its resolution, each pixel the mean of ``factor``²; a rest is cut off.

    Of 8 bits it has 12 then. A pixel is at the end of the range where one of those that it is made of may be clipped.
    """
    import cv2

    if factor == 1:
        return image
    height, width = (size // factor for size in image.shape[:2])
    whole = image[: height * factor, : width * factor]
    level, short = saturation(image), image.dtype == np.uint8
    means = cv2.resize(whole.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    blocks = (whole >= level).reshape(height, factor, width, factor, *image.shape[2:])
    full = _FULL if short else np.ceil(level / 0.99)
    values = np.where(blocks.any(axis=(1, 3)), full, means * (_SCALE if short else 1))
    return np.asarray(np.rint(values).astype(np.uint16))


def enlarged(fits: Fits, factor: int) -> Fits:
    """What was measured in images reduced by a ``factor``, in pixels of the full resolution."""
    return replace(
        fits,
        uv=(fits.uv + 0.5) * factor - 0.5,
        sigma=fits.sigma * factor,
        width=fits.width * factor,
        saturated=fits.saturated * factor**2,
    )
