"""Places in an image that may be an LED: small, and brighter than everything around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from urdfcal.arrays import Bools, Floats, Ints

# What is wider than this is a lamp, a window, a sheet of paper: a saturated LED of sigma 6 px is 25 px wide.
_WIDEST = 26
# Searching at half the resolution takes a quarter of the time; an LED is several pixels wide.
_STEP = 2
# A spot half a pixel wide loses least in a filter of its own width; LEDs are 0.6 to 3 of these pixels wide.
_BLUR = 0.8
# In deviations of the filtered background. Of pure noise, an image of a million pixels has one candidate at 5 and
# none at 6 (12 images); a spot of peak 6 sigma stands 8 high if it is 1 px wide, 18 if 1.5 px.
_THRESHOLD = 6.0
# Pixels above half the height, of 2 x 2: an LED of 6 px that is saturated four times has 118. The rims of larger
# lamps stand out as well, but their lamp belongs to them.
_LARGEST_AREA = 125
# Share of a pixel's light that none of its neighbours has: 1 of a hot pixel, 0.77 of a spot 0.5 px wide.
_SHARPEST = 0.88
# Two places nearer than this are one. [px]
_APART = 10
# An LED hides behind a dozen other small lights only in a shop. Of what is no LED at sight, a few are told.
_MOST, _MOST_OTHERS = 12, 3
# Peaks that are looked at: a page of text in view has thousands.
_MOST_PEAKS = 300

HOT, LARGE = "a hot pixel", "larger than an LED"


@dataclass(frozen=True, eq=False)
class Candidates:
    """Small lights in one image, the most prominent first.

    Attributes:
        places: (n, 2) pixels u, v, to within about two.
        others: (m, 2) pixels of what is no LED at sight.
        reasons: m texts why.
    """

    places: Ints
    others: Ints
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class StaticImage:
    """What stands still in the images of a camera.

    Attributes:
        image: (h, w) counts.
        small: (h / 2, w / 2) the same at half the resolution.
        damping: (h / 2, w / 2) noise of dark pixels over that of each one.
    """

    image: NDArray[np.float32]
    small: NDArray[np.float32]
    damping: NDArray[np.float32]


def find_candidates(image: NDArray[np.float32], still: StaticImage | None = None) -> Candidates:
    """Find small lights in an image (h, w) of counts, other than those that stand ``still``."""
    small = halved(image)
    if still is not None:
        small = (small - still.small) * still.damping
    peaks = _peaks(image, small, still)
    hot, excess = peaks.hot, peaks.excess
    if len(hot):
        # An LED may stand beside a hot pixel, and then is no peak of its own.
        u, v = (hot // _STEP).T
        if still is not None:
            excess = excess * still.damping[v, u]
        np.subtract.at(small, (v, u), excess / _STEP**2)
        peaks = _peaks(image, small, still)
    # Of the rims of one lamp, one is enough.
    others = {HOT: _apart(hot, _MOST_OTHERS), LARGE: _apart(peaks.places[peaks.large], _MOST_OTHERS, 10 * _APART)}
    reasons = tuple(reason for reason, of in others.items() for _ in of)
    return Candidates(_apart(peaks.places[~peaks.large], _MOST), np.concatenate(list(others.values())), reasons)


def halved(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image at half its resolution, each pixel the mean of four."""
    import cv2

    height, width = image.shape
    even = image[: height // _STEP * _STEP, : width // _STEP * _STEP]
    return np.asarray(cv2.resize(even, (width // _STEP, height // _STEP), interpolation=cv2.INTER_AREA))


@dataclass(frozen=True, eq=False)
class _Peaks:
    """Places that stand out, highest first.

    Attributes:
        places: (n, 2) pixels.
        large: (n,) which of them are lamps.
        hot: (h, 2) hot pixels, each once.
        excess: (h,) what they have more than the pixels around them. [counts]
    """

    places: Ints
    large: Bools
    hot: Ints
    excess: Floats


def _peaks(image: NDArray[np.float32], small: NDArray[np.float32], still: StaticImage | None) -> _Peaks:
    import cv2

    small = cv2.GaussianBlur(small, (5, 5), _BLUR)
    # What remains of an image when everything narrower than the kernel is cut off, taken away.
    side = _WIDEST // _STEP
    relief = cv2.morphologyEx(small, cv2.MORPH_TOPHAT, np.ones((side, side), np.uint8))
    deviation, ordinary = _spread(relief[::5, ::5])
    high = relief > ordinary + _THRESHOLD * deviation
    v, u = np.nonzero(high & (relief >= cv2.dilate(relief, np.ones((5, 5), np.uint8))))
    order = np.argsort(-relief[v, u], kind="stable")[:_MOST_PEAKS]
    u, v = u[order], v[order]
    large = _areas(small, relief, u, v) > _LARGEST_AREA
    places = np.stack([u, v], axis=1) * _STEP
    single, hot, excess = _single(image, places, still)
    single &= ~large
    hot, each = np.unique(hot[single], axis=0, return_index=True)
    return _Peaks(places[~single], large[~single], hot, excess[single][each])


def _apart(places: Ints, most: int, distance: int = _APART) -> Ints:
    """The first ``most`` of (n, 2) places of which no two are near each other."""
    kept: list[int] = []
    for i, place in enumerate(places):
        if len(kept) == most:
            break
        if not kept or np.abs(places[kept] - place).sum(axis=1).min() > distance:
            kept.append(i)
    return places[kept].astype(np.intp).reshape(-1, 2)


def _areas(small: NDArray[Any], relief: NDArray[Any], u: Ints, v: Ints) -> Ints:
    """Pixels around each peak that are above half its height."""
    reach = np.arange(-_WIDEST // _STEP, _WIDEST // _STEP + 1)
    half = small[v, u] - 0.5 * relief[v, u]
    return np.asarray((_around(small, u, v, reach) > half[:, None, None]).sum(axis=(1, 2)))


def _single(image: NDArray[np.float32], places: Ints, still: StaticImage | None) -> tuple[Bools, Ints, Floats]:
    """Which places (n, 2) are one pixel, whose neighbours show next to nothing of it; that pixel; its excess."""
    u, v = places.T
    reach = np.arange(-7, 9)
    around = _around(image, u, v, reach).astype(np.float64)
    if still is not None:
        around -= _around(still.image, u, v, reach)
    around -= np.median(around.reshape(len(u), reach.size**2), axis=1)[:, None, None]
    each = np.arange(len(u))
    top = around[:, 5:11, 5:11].reshape(len(u), 36).argmax(axis=1)
    row, column = 5 + top // 6, 5 + top % 6
    brightest = around[each, row, column]
    beside = np.max([around[each, row + a, column + b] for a, b in ((0, 1), (0, -1), (1, 0), (-1, 0))], axis=0)
    height, width = image.shape
    pixels = np.stack([np.clip(u - 7 + column, 0, width - 1), np.clip(v - 7 + row, 0, height - 1)], axis=1)
    return np.asarray(beside < (1.0 - _SHARPEST) * brightest), pixels, brightest - np.maximum(beside, 0.0)


def _around(image: NDArray[Any], u: Ints, v: Ints, reach: Ints) -> NDArray[Any]:
    """Squares (n, r, r) of pixels around places, the image's rim repeated."""
    rows = np.clip(v[:, None] + reach, 0, image.shape[0] - 1)
    columns = np.clip(u[:, None] + reach, 0, image.shape[1] - 1)
    return np.asarray(image[rows[:, :, None], columns[:, None, :]])


def _spread(values: NDArray[Any]) -> tuple[float, float]:
    """Standard deviation and median of the background, whatever stands out of it."""
    low, median = np.percentile(values, [15.87, 50.0])
    # Rounding leaves flat images without any spread at all.
    return max(float(median - low), 0.02), float(median)
