"""A second look for an LED where it should be, in a window that keeps out what is beside it, such as a bright arm."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.detection.spots.centroid import HALF, Crops, fit_spots
from urdfcal.detection.spots.detector import Spots, judged, once
from urdfcal.detection.spots.gaussian import Rows
from urdfcal.detection.spots.preprocessing import Background, read_background, read_exposures, separated
from urdfcal.images.files import in_parallel

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.images.files import Colour, ImageSequence

# An LED before an arm is as wide and as bright as elsewhere: it is nearer or farther by a third, and turned away.
_AS_WIDE, _AS_BRIGHT = 1.3, 3.0
# Of what is looked for beside the place where the LED should be, two pixels are those of its search.
_SEARCHED = 2.0


@dataclass(frozen=True, eq=False)
class Expected:
    """An LED that K images should show.

    Attributes:
        image: (K,) index of each.
        uv: (K, 2) where. [px]
        reach: (K,) how far from there it may be. [px]
        width: of its spot elsewhere. [px]
        flux: how bright it is elsewhere.
    """

    image: Ints
    uv: Floats
    reach: Floats
    width: float
    flux: float


def look_again(
    images: ImageSequence, resolution: tuple[int, int], colour: Colour, place: Ints, expected: Expected
) -> Spots:
    """Find an LED that is as wide and as bright as expected, where it is expected.

    Args:
        images: of one camera.
        resolution: (width, height) that they must have. [px]
        colour: of the LED.
        place: (P,) of every image a number that is the same where the LED should be at the same place.
        expected: where it should be.

    Returns:
        What may be it, at most some lights an image.

    Raises:
        CameraError: an image cannot be read, or has another size.
    """
    background = read_background(images, place, resolution, colour)
    look = partial(_crops, images, resolution, colour, background, expected)
    crops = list(in_parallel(look, range(len(expected.image))))
    spots = Spots.of(np.repeat(expected.image, [len(of) for of in crops]), fit_spots(Rows.join(crops), expected.width))
    spots = judged(spots, resolution)
    wide, bright = spots.fits.width / expected.width, spots.fits.flux / expected.flux
    spots = spots.rejected(np.abs(np.log(wide)) > np.log(_AS_WIDE), "wider or narrower than the LED")
    spots = spots.rejected(np.abs(np.log(bright)) > np.log(_AS_BRIGHT), "brighter or darker than the LED")
    return once(spots[spots.good])


def _crops(
    images: ImageSequence,
    resolution: tuple[int, int],
    colour: Colour,
    background: Background | None,
    expected: Expected,
    k: int,
) -> Crops:
    """Cut out the lights that are where the LED should be in the k-th of the images that should show it."""
    uv, reach = expected.uv[k], float(expected.reach[k]) + _SEARCHED
    low = np.maximum(np.floor(uv - reach - HALF), 0).astype(int) // 2 * 2
    high = np.minimum(np.ceil(uv + reach + HALF), resolution).astype(int) // 2 * 2
    part = slice(low[1], high[1]), slice(low[0], high[0])
    exposed, unlit = read_exposures(images[int(expected.image[k])], resolution)
    dark = None if unlit is None else unlit.part(*part)
    # Where the arm hides the background, that has edges which the image has not.
    still = (None,) if background is None else (None, background.part(*part))
    crops = Rows.join([separated(exposed.part(*part), dark, colour, of).crops for of in still])
    crops = replace(crops, centre=crops.centre + low)
    return crops[np.linalg.norm(crops.centre - uv, axis=1) <= reach]
