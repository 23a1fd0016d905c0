"""One image: read, freed of what stands still, and cut into crops around its small lights.

What may be an LED is small, and brighter than everything around it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.detection.spots.centroid import HALF, Crops
from urdfcal.detection.spots.reduced import clipped, reduced
from urdfcal.images.files import COLOURS, channel, in_parallel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.images.files import Colour, Image, ImageSequence, SequenceImage

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
# Images whose median is taken: the LED, and the arm before a lamp, may be in the same place in three of them.
SAMPLE = 7
# A large spot, with its wings, is in a third of the images at the same place, and in four of seven at some: of more
# images a lower rank than the middle one is taken. Spots of 22 px in 480 x 360 were off by 0.4 px, now by 0.03 px.
_LARGE_SAMPLE, _LARGE_RANK = 15, 0.3
# The median's own noise costs 10 % of accuracy where the background dominates: it is taken off only where the
# background differs by more than this many deviations of an image's noise within a crop.
_STRUCTURE = 3.0
# Deviations of an image's noise in the median, which an LED in one image of seven moves by one, or a whole count.
_STANDING = 5.0
# Rounding hides noise below this. [counts]
_LEAST_NOISE = 0.3
# Shot noise is told from pixels this many deviations above the dark, if there are as many of them.
_BRIGHT, _ENOUGH = 20.0, 200
# With fewer places of the LED, it may be in the same one in half of the sample.
_FEWEST = SAMPLE + 1

HOT, LARGE = "a hot pixel", "larger than an LED"


@dataclass(frozen=True, eq=False)
class Background:
    """The median of some images, or less: what stands still in those of a camera.

    Attributes:
        values: (h, w) counts.
        image: (h, w) what is to be taken off the images in which LEDs are searched; they differ for a coloured one.
        small: (h / 2, w / 2) the same at half the resolution.
        damping: (h / 2, w / 2) noise of dark pixels over that of each one.
        blind: (h, w) pixels that are clipped without the LED already.
        noise: of an image where it is dark, one standard deviation. [counts]
        lights: (k, 2) pixels of the small lights in it.
    """

    values: NDArray[np.float32]
    image: NDArray[np.float32]
    small: NDArray[np.float32]
    damping: NDArray[np.float32]
    blind: Bools
    noise: float
    lights: Ints

    def part(self, rows: slice, columns: slice) -> Background:
        """Return that of a part of the images, which begins at even rows and columns."""
        half = slice(rows.start // _STEP, rows.stop // _STEP), slice(columns.start // _STEP, columns.stop // _STEP)
        whole = {name: getattr(self, name)[rows, columns] for name in ("values", "image", "blind")}
        return replace(self, **whole, small=self.small[half], damping=self.damping[half])


@dataclass(frozen=True, eq=False)
class Exposed:
    """An image that was read.

    Attributes:
        image: (h, w) or (h, w, 3) counts.
        full: of the same shape, which of them may be clipped.
    """

    image: Image
    full: Bools

    def part(self, rows: slice, columns: slice) -> Exposed:
        """Return a part of it."""
        return Exposed(self.image[rows, columns], self.full[rows, columns])


@dataclass(frozen=True, eq=False)
class Preprocessed:
    """One image.

    Attributes:
        crops: around its n small lights.
        purity: (n,) share of the named colour in each.
        others: pixels (m, 2) of what is no LED at sight, by the reason why.
    """

    crops: Crops
    purity: Floats
    others: dict[str, Ints]


def preprocess(
    shown: SequenceImage,
    resolution: tuple[int, int],
    colour: Colour,
    background: Background | None,
    factor: int = 1,
) -> Preprocessed:
    """Read one image, reduce its resolution by a factor, and cut out its lights, in pixels of that.

    Raises:
        CameraError: it cannot be read, or has another size than ``resolution`` (width, height).
    """
    return separated(*read_exposures(shown, resolution, factor), colour, background)


def read_exposures(
    shown: SequenceImage, resolution: tuple[int, int], factor: int = 1
) -> tuple[Exposed, Exposed | None]:
    """Read an image, and the dark one that is to be subtracted, and reduce their resolution by a factor.

    Raises:
        CameraError: one cannot be read, or has another size than ``resolution`` (width, height).
    """
    lit, dark = shown.lit(resolution), shown.unlit(resolution)
    exposed = Exposed(reduced(lit, factor), clipped(lit, factor))
    return exposed, None if dark is None else Exposed(reduced(dark, factor), clipped(dark, factor))


def separated(exposed: Exposed, unlit: Exposed | None, colour: Colour, background: Background | None) -> Preprocessed:
    """Free one image of what stands still, and cut out its lights."""
    image, full = exposed.image, exposed.full
    values = channel(image, colour)
    search = _searched(image, values, colour)
    if unlit is not None:
        dark, dark_full = unlit.image, unlit.full
        without = channel(dark, colour)
        search, values = search - _searched(dark, without, colour), values - without
        background = None
    places, others = find_candidates(search, background)
    reach = np.arange(-HALF, HALF + 1)
    index = _squares(places, reach, values.shape)
    # The rim is repeated where a crop reaches out of the image.
    v, u = places[:, 1, None, None] + reach[:, None], places[:, 0, None, None] + reach
    usable, cut = (index[0] == v) & (index[1] == u), values[index]
    if unlit is not None:
        usable &= ~_of_colour(dark_full, colour)[index]
    elif background is not None:
        usable &= ~background.blind[index]
        here = background.values[index]
        # Means over 7 x 7 pixels, so that the median's noise is no structure.
        side = here.shape[1] // 7
        means = here[:, : 7 * side, : 7 * side].reshape(len(here), side, 7, side, 7).mean(axis=(2, 4))
        structured = np.ptp(means, axis=(1, 2)) > _STRUCTURE * background.noise
        cut = cut - np.where(structured[:, None, None], here, np.float32(0.0))
    crops = Crops(places, cut, usable, _of_colour(full, colour)[index])
    return Preprocessed(crops, _purity(image, places, colour, full), others)


def read_background(
    sequence: ImageSequence,
    place: Ints,
    resolution: tuple[int, int],
    colour: Colour,
    threads: int | None = None,
    factor: int = 1,
) -> Background | None:
    """Read some images with the LED in different places, for what stands still in them.

    Args:
        sequence: images of one camera.
        place: (P,) of every image a number that is the same where the LED should be at the same place.
        resolution: (width, height) that they must have. [px]
        colour: of the LED.
        threads: that read.
        factor: by which their resolution is reduced.

    Returns:
        None where the images are too few, or have dark ones to be subtracted.
    """
    _, first = np.unique(place, return_index=True)
    if len(first) < _FEWEST:
        return None
    count = SAMPLE if factor == 1 else min(_LARGE_SAMPLE, len(first))
    sample = np.sort(first)[np.linspace(0, len(first) - 1, count).astype(np.intp)]
    rank = round((0.5 if factor == 1 else _LARGE_RANK) * (count - 1))

    def read(i: int) -> tuple[Image, Bools, Image | None]:
        shown = sequence[i]
        lit = shown.lit(resolution)
        return reduced(lit, factor), _of_colour(clipped(lit, factor), colour), shown.unlit(resolution)

    images, full = [], []
    for image, clip, dark in list(in_parallel(read, sample.tolist(), threads)):
        if dark is not None:
            return None
        images.append(image)
        full.append(clip)
    each = [channel(image, colour) for image in images]
    values = image = _ranked(each, rank)
    if colour != "any" and images[0].ndim == 3:
        image = _ranked([_searched(*both, colour) for both in zip(images, each, strict=True)], rank)
    change = each[0] - values
    # Below the middle rank, all is darker than usual.
    change -= np.median(change[::5, ::5])
    noise = max(1.48 * float(np.median(np.abs(change[::5, ::5]))), _LEAST_NOISE)
    blind = np.mean(full, axis=0) > 0.5
    # From how much lamps changed between two images.
    light = np.maximum(values - np.median(values[::5, ::5]), np.float32(0.0))
    bright = (light > _BRIGHT * noise) & ~blind
    damping = np.ones_like(values)
    if np.count_nonzero(bright) >= _ENOUGH:
        # Median, because the arm may have hidden a lamp.
        shot = (1.48 * float(np.median(np.abs(change[bright]) / np.sqrt(light[bright])))) ** 2
        damping = 1.0 / np.sqrt(1.0 + np.float32(shot / noise**2) * light)
    lights = find_candidates(image, apart=False)[0]
    around = (image[max(v - HALF, 0) : v + HALF, max(u - HALF, 0) : u + HALF] for u, v in lights)
    above = np.array([image[v, u] - np.median(of) for (u, v), of in zip(lights, around, strict=True)])
    return Background(values, image, halved(image), halved(damping), blind, noise, lights[above > _STANDING * noise])


def find_candidates(
    image: NDArray[np.float32], still: Background | None = None, *, apart: bool = True
) -> tuple[Ints, dict[str, Ints]]:
    """Find small lights in an image (h, w) of counts, other than those that stand ``still``.

    Args:
        image: to be searched.
        still: what stands still in it.
        apart: whether a small light may be beside something large, such as a bright arm.

    Returns:
        Their places, pixels (n, 2) u, v, to within about two, the most prominent first; and the pixels (m, 2) of what
        is no LED at sight, by the reason why.
    """
    small = halved(image)
    if still is not None:
        small = small - still.small
    places, large, hot, excess = _peaks(image, small, still, apart)
    if len(hot):
        # An LED may stand beside a hot pixel, and then is no peak of its own.
        u, v = (hot // _STEP).T
        np.subtract.at(small, (v, u), excess / _STEP**2)
        places, large, _, _ = _peaks(image, small, still, apart)
    # Of the rims of one lamp, one is enough.
    others = {HOT: _apart(hot, _MOST_OTHERS), LARGE: _apart(places[large], _MOST_OTHERS, 10 * _APART)}
    return _apart(places[~large], _MOST), others


def halved(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image at half its resolution, each pixel the mean of four."""
    import cv2

    height, width = image.shape
    even = image[: height // _STEP * _STEP, : width // _STEP * _STEP]
    return np.asarray(cv2.resize(even, (width // _STEP, height // _STEP), interpolation=cv2.INTER_AREA))


def _peaks(
    image: NDArray[np.float32], small: NDArray[np.float32], still: Background | None, apart: bool
) -> tuple[Ints, Bools, Ints, Floats]:
    """Places that stand out, highest first.

    Returns:
        Pixels (n, 2); which of them (n,) are lamps; hot pixels (h, 2), each once; and what they (h,) have more than the
        pixels around them. [counts]
    """
    import cv2

    small = cv2.GaussianBlur(small, (5, 5), _BLUR)
    # What remains of an image when everything narrower than the kernel is cut off, taken away.
    side = _WIDEST // _STEP
    relief = cv2.morphologyEx(small, cv2.MORPH_TOPHAT, np.ones((side, side), np.uint8))
    # Damped last: the noise of lamps would cut a bright arm into pieces.
    judged = relief if still is None else relief * still.damping
    # Of the background, whatever stands out of it; rounding leaves flat images without any spread at all.
    low, ordinary = np.percentile(judged[::5, ::5], [15.87, 50.0])
    high = judged > float(ordinary) + _THRESHOLD * max(float(ordinary - low), 0.02)
    v, u = np.nonzero(high & (judged >= cv2.dilate(judged, np.ones((5, 5), np.uint8))))
    order = np.argsort(-judged[v, u], kind="stable")[:_MOST_PEAKS]
    u, v = u[order], v[order]
    places = np.stack([u, v], axis=1)
    # Pixels around each peak that are above half its height.
    around = small[_squares(places, np.arange(-_WIDEST // _STEP, _WIDEST // _STEP + 1), small.shape)]
    half = small[v, u] - 0.5 * relief[v, u]
    high = around > half[:, None, None]
    large = high.sum(axis=(1, 2)) > _LARGEST_AREA
    if apart:
        _keep_apart(large, high)
    places = places * _STEP
    single, hot, excess = _single(image, places, still)
    single &= ~large
    hot, each = np.unique(hot[single], axis=0, return_index=True)
    return places[~single], large[~single], hot, excess[single][each]


def _keep_apart(large: Bools, high: Bools) -> None:
    """Call those (n,) not large whose high pixels (n, r, r) do not hang together, as of an LED beside a bright arm."""
    import cv2

    middle = high.shape[1] // 2
    for i in np.flatnonzero(large):
        _, label = cv2.connectedComponents(high[i].astype(np.uint8), connectivity=4)
        large[i] = np.count_nonzero(label == label[middle, middle]) > _LARGEST_AREA


def _apart(places: Ints, most: int, distance: int = _APART) -> Ints:
    """The first ``most`` of (n, 2) places of which no two are near each other."""
    kept: list[int] = []
    for i, place in enumerate(places):
        if len(kept) == most:
            break
        if not kept or np.abs(places[kept] - place).sum(axis=1).min() > distance:
            kept.append(i)
    return places[kept].astype(np.intp).reshape(-1, 2)


def _single(image: NDArray[np.float32], places: Ints, still: Background | None) -> tuple[Bools, Ints, Floats]:
    """Which places (n, 2) are one pixel, whose neighbours show next to nothing of it; that pixel; its excess."""
    u, v = places.T
    index = _squares(places, np.arange(-7, 9), image.shape)
    around = image[index].astype(np.float64)
    if still is not None:
        around -= still.image[index]
    around -= np.median(around.reshape(len(u), 256), axis=1)[:, None, None]
    each = np.arange(len(u))
    top = around[:, 5:11, 5:11].reshape(len(u), 36).argmax(axis=1)
    row, column = 5 + top // 6, 5 + top % 6
    brightest = around[each, row, column]
    beside = np.max([around[each, row + a, column + b] for a, b in ((0, 1), (0, -1), (1, 0), (-1, 0))], axis=0)
    height, width = image.shape
    pixels = np.stack([np.clip(u - 7 + column, 0, width - 1), np.clip(v - 7 + row, 0, height - 1)], axis=1)
    return np.asarray(beside < (1.0 - _SHARPEST) * brightest), pixels, brightest - np.maximum(beside, 0.0)


def _squares(places: Ints, reach: Ints, shape: tuple[int, ...]) -> tuple[Ints, Ints]:
    """Index of squares (n, r, r) of pixels around places (n, 2) in images of a shape, the rim repeated."""
    rows = np.clip(places[:, 1, None] + reach, 0, shape[0] - 1)
    columns = np.clip(places[:, 0, None] + reach, 0, shape[1] - 1)
    return rows[:, :, None], columns[:, None, :]


def _searched(image: Image, values: NDArray[np.float32], colour: Colour) -> NDArray[np.float32]:
    """The image in which an LED of ``colour`` stands out: where its channel exceeds the mean, white lights shrink."""
    if colour == "any" or image.ndim == 2:
        return values
    return 1.5 * values - 0.5 * channel(image, "any")


def _of_colour(full: Bools, colour: Colour) -> Bools:
    """Which pixels (h, w) of those clipped, (h, w) or (h, w, 3), are so in the named channel, or in any there is."""
    if full.ndim == 2:
        return full
    return np.asarray(full.any(axis=-1) if colour == "any" else full[..., COLOURS.index(colour) - 1])


def _purity(image: Image, centre: Ints, colour: Colour, full: Bools) -> Floats:
    """Share (n,) of the light around each candidate that is of the named colour; 1 in a grey image."""
    purity = np.ones(len(centre))
    if colour == "any" or image.ndim == 2:
        return purity
    for i, (u, v) in enumerate(centre):
        near = slice(max(0, v - 8), v + 9), slice(max(0, u - 8), u + 9)
        patch = image[near].reshape(-1, 3).astype(np.float64)
        light = patch - np.median(patch, axis=0)
        # Where one channel is clipped, the colour is lost: the rim tells it.
        light = np.maximum(light[~full[near].reshape(-1, 3).any(axis=1)], 0.0)
        bright = light.sum(axis=1)
        total = light[bright > 0.3 * bright.max(initial=0.0)].sum(axis=0)
        purity[i] = total[COLOURS.index(colour) - 1] / max(float(total.sum()), 1e-9)
    return purity


def _ranked(images: Sequence[NDArray[np.float32]], rank: int) -> NDArray[np.float32]:
    """Of each pixel the value of a rank: 0 is its least in all images."""
    return np.asarray(np.partition(np.stack(images), rank, axis=0)[rank])
