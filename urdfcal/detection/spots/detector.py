"""LEDs in the images of one camera: every small light there is, and whether it looks like an LED.

Nothing here knows the robot: which of several lights is the LED is decided where the arm is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.detection.spots.centroid import Fits, fit_spots
from urdfcal.detection.spots.gaussian import Rows
from urdfcal.detection.spots.preprocessing import HOT, LARGE, Preprocessed, preprocess, read_background
from urdfcal.detection.spots.reduced import enlarged
from urdfcal.images.files import in_parallel

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.images.files import Colour, ImageSequence

# Images whose crops are fitted together: with a dozen lights each, their crops take as much as six images.
_TOGETHER = 64

# An LED cannot be measured below this; of noise alone nothing comes so far. [deviations of the peak]
_FAINTEST = 5.0
# The lens blurs every light a little: by less than 0.4 px on no camera whose LED could be measured to a tenth.
_SMALLEST, _LARGEST = 0.4, 6.0
# A lens's coma reaches 1.3 in the corners. A streak 4 widths long has 1.5: its centre is off by the unevenness of
# the motion, a fraction of a width.
_ELONGATED = 1.5
# What a spot leaves unexplained of its core. An evenly lit disc (an LED out of focus, 2 to 6 px in radius) has 5 to
# 9 %, and is found to 0.01 px all the same; two lights that the fit took for one 16 % and more.
_MISFIT = 0.12
# A second light in the same window, three widths away: 15 % as high it moves the centre by 0.04 px, 30 % by 0.1 px.
_LOBE = 0.15
# Share of the light in the named colour: 1/3 is white, a red LED has above 0.6 on any Bayer sensor.
_PURITY = 0.45

# An LED that is near, or out of focus, has a larger spot: if many images show something large and no LED, they are
# searched at half the resolution, and so on. A lamp that the arm hides now and then is in less than a quarter.
_FACTORS = (2, 4)
_FEWEST_LARGE, _LARGE_SHARE = 3, 0.25
# A lens darkens towards the corners of its image, most by a third, a factor that rises evenly across a spot: it moves a
# Gaussian's centre by its variance times the relative slope, towards the middle, and nothing in the image shows it.
_FALL_OFF = 0.35
# Lights this near to each other in different images are one that stands still. [px]
_SAME_PLACE = 2.0
# In so many images with the LED elsewhere: chance brings a moving LED back to within two pixels in one in 10,000.
_STILL_COUNT, _STILL_SHARE = 3, 0.1


@dataclass(frozen=True, eq=False)
class Spots(Rows):
    """Small lights in the images of one camera.

    Attributes:
        image: (n,) index of the image.
        fits: where they are and what they look like.
        reasons: (n,) texts why a light is not taken for an LED; empty where it may be one.
        still: (k, 2) where small lights stand still, which were taken off the images. [px]
    """

    image: Ints
    fits: Fits
    reasons: NDArray[Any]
    still: Ints = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))

    @classmethod
    def of(cls, image: Ints | int, fits: Fits, reason: str = "") -> Spots:
        """Lights in an image, or in (n,) several, all of them rejected with ``reason`` if there is one."""
        return cls(np.broadcast_to(image, len(fits)), fits, np.full(len(fits), reason, dtype=object))

    @property
    def good(self) -> Bools:
        """(n,) which may be LEDs."""
        return np.asarray(self.reasons == "")

    def rejected(self, which: Bools, reason: str | NDArray[Any]) -> Spots:
        """The same lights, ``which`` (n,) of those that were good rejected with ``reason``, or (n,) one of each."""
        return replace(self, reasons=np.where(self.good & which, reason, self.reasons))


def find_spots(
    images: ImageSequence,
    resolution: tuple[int, int],
    colour: Colour = "any",
    place: Ints | None = None,
    progress: Callable[[int], object] | None = None,
    threads: int | None = None,
) -> Spots:
    """Find and measure every small light in the images of one camera; a larger one where many show no small one.

    Args:
        images: of the same camera.
        resolution: (width, height) that they must have. [px]
        colour: of the LED: lights of other colours are rejected, and the others' pixels not used.
        place: (P,) of every image a number that is the same where the LED should be at the same place; without,
            it is elsewhere in each.
        progress: called with the number of images read since the last call.
        threads: that read, one a core by default.

    Raises:
        CameraError: an image cannot be read, or has another size.
    """
    place = np.arange(len(images)) if place is None else place
    spots = _found(images, resolution, colour, place, progress, threads)
    for factor in _FACTORS:
        without = np.setdiff1d(np.arange(len(images)), spots.image[spots.good])
        large = np.intersect1d(spots.image[spots.reasons == LARGE], without)
        if large.size < max(_FEWEST_LARGE, _LARGE_SHARE * len(images)):
            break
        wide = _found(images, resolution, colour, place, None, threads, factor)
        # What is small was judged at the full resolution.
        found = wide[wide.good & (wide.fits.width > _LARGEST) & np.isin(wide.image, without)]
        # Of one light, one row is enough.
        kept = (spots.reasons != LARGE) | ~np.isin(spots.image, found.image)
        spots = Rows.join([spots[kept], found])
        spots = spots[np.argsort(spots.image, kind="stable")]
    return spots


def fall_off(fits: Fits, resolution: tuple[int, int]) -> Floats:
    """How far (n,) a lens that darkens towards its corners may have moved spots, one deviation of u and v. [px]."""
    half = np.array(resolution) / 2.0
    slope = 2.0 * _FALL_OFF * np.linalg.norm(fits.uv + 0.5 - half, axis=1) / (half @ half)
    return np.asarray(fits.width**2 * slope / np.sqrt(2.0))


def _found(
    images: ImageSequence,
    resolution: tuple[int, int],
    colour: Colour,
    place: Ints,
    progress: Callable[[int], object] | None,
    threads: int | None,
    factor: int = 1,
) -> Spots:
    """Find the lights in images whose resolution is reduced by a factor; in pixels of the full one."""
    background = read_background(images, place, resolution, colour, threads, factor)
    look = partial(preprocess, resolution=resolution, colour=colour, background=background, factor=factor)
    looks = in_parallel(look, images, threads, progress)
    size = (resolution[0] // factor, resolution[1] // factor)
    batches = [Spots.of(0, Fits.unknown(np.zeros((0, 2), dtype=np.intp)))]
    for first in range(0, len(images), _TOGETHER):
        batches.append(_measured(list(islice(looks, _TOGETHER)), first, size, colour))
    spots = Rows.join(batches)
    fits = enlarged(spots.fits, factor)
    spots = replace(spots, fits=replace(fits, sigma=np.hypot(fits.sigma, fall_off(fits, resolution))))
    if background:
        spots = replace(spots, still=background.lights * factor)
    return spots.rejected(_stands_still(spots, place), "it stands still")


def _stands_still(spots: Spots, place: Ints) -> Bools:
    """Which spots (n,) are where a light also is in images with the LED elsewhere."""
    from scipy.spatial import cKDTree

    if not len(spots.fits):
        return np.zeros(0, dtype=bool)
    tree = cKDTree(spots.fits.uv)
    of = place[spots.image]
    counts = np.array([np.unique(of[near]).size for near in tree.query_ball_point(spots.fits.uv, _SAME_PLACE)])
    return np.asarray(counts >= max(_STILL_COUNT, _STILL_SHARE * np.unique(place).size))


def _measured(looks: Sequence[Preprocessed], first: int, resolution: tuple[int, int], colour: Colour) -> Spots:
    """Fit and judge the lights of some images, the ``first`` and following."""
    numbers = range(first, first + len(looks))
    crops = Rows.join([seen.crops for seen in looks])
    spots = Spots.of(np.repeat(numbers, [len(seen.crops) for seen in looks]), fit_spots(crops))
    if colour != "any":
        spots = spots.rejected(np.concatenate([seen.purity for seen in looks]) < _PURITY, f"not {colour}")
    parts = [once(judged(spots, resolution))]
    for number, seen in zip(numbers, looks, strict=True):
        parts += [Spots.of(number, Fits.unknown(places), reason) for reason, places in seen.others.items()]
    joined = Rows.join(parts)
    return joined[np.argsort(joined.image, kind="stable")]


def judged(spots: Spots, resolution: tuple[int, int]) -> Spots:
    """Reject what does not look like an LED, each with the first reason that holds."""
    fits = spots.fits
    # In widths as they appear, the pixel's own included.
    apparent = np.sqrt(fits.width**2 + 1.0 / 12.0)
    distance = np.minimum(fits.uv + 0.5, np.array(resolution) - 0.5 - fits.uv).min(axis=1)
    spots = spots.rejected(distance < 2.0 * apparent, "cut by the border")
    spots = spots.rejected(fits.width < _SMALLEST, HOT)
    spots = spots.rejected(fits.significance < _FAINTEST, "too faint")
    spots = spots.rejected(fits.width > _LARGEST, LARGE)
    spots = spots.rejected(fits.ratio > _ELONGATED, "elongated: a streak or a reflection on an edge")
    spots = spots.rejected(fits.lobe > _LOBE, "another light beside it")
    spots = spots.rejected(fits.misfit > _MISFIT, "not a round spot")
    return spots.rejected(~fits.found | ~np.isfinite(fits.sigma), "no spot")


def once(spots: Spots) -> Spots:
    """Without fits that met in the same place as one before them in the same image."""
    kept = np.ones(len(spots.fits), dtype=bool)
    for image in np.unique(spots.image):
        rows = np.flatnonzero(spots.image == image)
        apart = np.linalg.norm(spots.fits.uv[rows, None] - spots.fits.uv[rows], axis=2) >= _SAME_PLACE
        kept[rows] = (apart | ~np.tri(len(rows), k=-1, dtype=bool)).all(axis=1)
    return spots[kept]
