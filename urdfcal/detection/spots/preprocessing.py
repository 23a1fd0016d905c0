"""One image: read, freed of what stands still, and cut into crops around its small lights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.detection.spots.candidates import StaticImage, find_candidates, halved
from urdfcal.detection.spots.centroid import HALF, Crops
from urdfcal.images.files import channel, in_parallel, saturation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.images.files import Colour, Image, ImageSequence, SequenceImage

# Images whose median is taken: the LED, and the arm before a lamp, may be in the same place in three of them.
SAMPLE = 7
# The median's own noise costs 10 % of accuracy where the background dominates: it is taken off only where the
# background differs by more than this many deviations of an image's noise within a crop.
_STRUCTURE = 3.0
# Rounding hides noise below this. [counts]
_LEAST_NOISE = 0.3
# Shot noise is told from pixels this many deviations above the dark, if there are as many of them.
_BRIGHT, _ENOUGH = 20.0, 200
# With fewer places of the LED, it may be in the same one in half of the sample.
_FEWEST = SAMPLE + 1


@dataclass(frozen=True, eq=False)
class Background:
    """The median of some images.

    Attributes:
        values: (h, w) counts.
        still: what is to be taken off the images in which LEDs are searched; they differ for a coloured one.
        blind: (h, w) pixels that are clipped without the LED already.
        noise: of an image where it is dark, one standard deviation. [counts]
        lights: (k, 2) pixels of the small lights in it.
    """

    values: NDArray[np.float32]
    still: StaticImage
    blind: Bools
    noise: float
    lights: Ints

    @classmethod
    def of(
        cls,
        images: Sequence[NDArray[np.float32]],
        clipped: float,
        searched: Sequence[NDArray[np.float32]] | None = None,
    ) -> Background:
        """Take the median of an odd number of ``images`` (h, w) in which a pixel of ``clipped`` may be clipped."""
        values = _median(images)
        change = images[0] - values
        noise = max(1.48 * float(np.median(np.abs(change[::5, ::5]))), _LEAST_NOISE)
        blind = values >= clipped
        image = values if searched is None else _median(searched)
        still = StaticImage(image, halved(image), halved(_damping(values, change, blind, noise)))
        return cls(values, still, blind, noise, find_candidates(image).places)

    def off(self, crops: NDArray[np.float32], index: Any) -> NDArray[np.float32]:
        """Take it off ``crops`` (n, s, s) where it has structure; ``index`` cuts the same crops out of it."""
        here = self.values[index]
        # Means over 7 x 7 pixels, so that the median's noise is no structure.
        side = here.shape[1] // 7
        means = here[:, : 7 * side, : 7 * side].reshape(len(here), side, 7, side, 7).mean(axis=(2, 4))
        structured = np.ptp(means, axis=(1, 2)) > _STRUCTURE * self.noise
        return np.asarray(crops - np.where(structured[:, None, None], here, np.float32(0.0)))


@dataclass(frozen=True, eq=False)
class Preprocessed:
    """One image.

    Attributes:
        crops: around its n small lights.
        purity: (n,) share of the named colour in each.
        others: (m, 2) pixels of what is no LED at sight.
        reasons: m texts why.
    """

    crops: Crops
    purity: Floats
    others: Ints
    reasons: tuple[str, ...]


def preprocess(
    shown: SequenceImage, resolution: tuple[int, int], colour: Colour, background: Background | None
) -> Preprocessed:
    """Read one image and cut out its lights.

    Raises:
        CameraError: it cannot be read, or has another size than ``resolution`` (width, height).
    """
    image = shown.lit(resolution)
    values = channel(image, colour)
    search = _searched(image, values, colour)
    blind, still = None, None
    if (dark := shown.unlit(resolution)) is not None:
        without = channel(dark, colour)
        search = search - _searched(dark, without, colour)
        values = values - without
        blind = _clippable(dark, colour) >= saturation(dark)
        background = None
    elif background is not None:
        blind, still = background.blind, background.still
    found = find_candidates(search, still)
    index, usable = _around(found.places, values.shape)
    if blind is not None:
        usable &= ~blind[index]
    cut = values[index] if background is None else background.off(values[index], index)
    clipped = saturation(image)
    crops = Crops(found.places, cut, usable, _clippable(image, colour)[index] >= clipped)
    return Preprocessed(crops, _purity(image, found.places, colour, clipped), found.others, found.reasons)


def read_background(
    sequence: ImageSequence, place: Ints, resolution: tuple[int, int], colour: Colour, threads: int | None = None
) -> Background | None:
    """Read some images with the LED in different places, for what stands still in them.

    Args:
        sequence: images of one camera.
        place: (P,) of every image a number that is the same where the LED should be at the same place.
        resolution: (width, height) that they must have. [px]
        colour: of the LED.
        threads: that read.

    Returns:
        None where the images are too few, or have dark ones to be subtracted.
    """
    _, first = np.unique(place, return_index=True)
    if len(first) < _FEWEST:
        return None
    sample = np.sort(first)[np.linspace(0, len(first) - 1, SAMPLE).astype(np.intp)]
    read = list(in_parallel(lambda i: _both(sequence[int(i)], resolution), sample, threads))
    if any(dark is not None for _, dark in read):
        return None
    images = [image for image, _ in read]
    values = [channel(image, colour) for image in images]
    searched = None
    if colour != "any" and images[0].ndim == 3:
        searched = [_searched(*both, colour) for both in zip(images, values, strict=True)]
    return Background.of(values, max(map(saturation, images)), searched)


def _both(shown: SequenceImage, resolution: tuple[int, int]) -> tuple[Image, Image | None]:
    return shown.lit(resolution), shown.unlit(resolution)


def _searched(image: Image, values: NDArray[np.float32], colour: Colour) -> NDArray[np.float32]:
    """The image in which an LED of ``colour`` stands out: where its channel exceeds the mean, white lights shrink."""
    if colour == "any" or image.ndim == 2:
        return values
    return 1.5 * values - 0.5 * channel(image, "any")


def _around(centre: Ints, shape: tuple[int, ...]) -> tuple[tuple[Ints, Ints], Bools]:
    """Index of crops around pixels ``centre`` (n, 2), and (n, s, s) what of them lies inside the image."""
    height, width = shape
    reach = np.arange(-HALF, HALF + 1)
    v, u = centre[:, 1, None] + reach, centre[:, 0, None] + reach
    inside = ((v >= 0) & (v < height))[:, :, None] & ((u >= 0) & (u < width))[:, None, :]
    return (np.clip(v, 0, height - 1)[:, :, None], np.clip(u, 0, width - 1)[:, None, :]), inside


def _clippable(image: Image, colour: Colour) -> Image:
    """Of an image the channel (h, w) that may be clipped: the named one, the largest, or the only one there is."""
    if image.ndim == 2:
        return image
    if colour == "any":
        return np.asarray(np.maximum.reduce([image[..., 0], image[..., 1], image[..., 2]]))
    return image[..., ("red", "green", "blue").index(colour)]


def _purity(image: Image, centre: Ints, colour: Colour, clipped: float) -> Floats:
    """Share (n,) of the light around each candidate that is of the named colour; 1 in a grey image."""
    purity = np.ones(len(centre))
    if colour == "any" or image.ndim == 2:
        return purity
    for i, (u, v) in enumerate(centre):
        patch = image[max(0, v - 8) : v + 9, max(0, u - 8) : u + 9].reshape(-1, 3).astype(np.float64)
        light = patch - np.median(patch, axis=0)
        # Where one channel is clipped, the colour is lost: the rim tells it.
        light = np.maximum(light[(patch < clipped).all(axis=1)], 0.0)
        bright = light.sum(axis=1)
        total = light[bright > 0.3 * bright.max(initial=0.0)].sum(axis=0)
        purity[i] = total[("red", "green", "blue").index(colour)] / max(float(total.sum()), 1e-9)
    return purity


def _median(images: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    middle = len(images) // 2
    result: NDArray[np.float32] = np.partition(np.stack(images), middle, axis=0)[middle]
    return result


def _damping(
    values: NDArray[np.float32], change: NDArray[np.float32], blind: Bools, noise: float
) -> NDArray[np.float32]:
    """Noise in the dark over that of each pixel, from how much lamps changed between two images."""
    light = np.maximum(values - np.median(values[::5, ::5]), np.float32(0.0))
    bright = (light > _BRIGHT * noise) & ~blind
    if np.count_nonzero(bright) < _ENOUGH:
        return np.ones_like(values)
    # Median, because the arm may have hidden a lamp.
    shot = (1.48 * float(np.median(np.abs(change[bright]) / np.sqrt(light[bright])))) ** 2
    result: NDArray[np.float32] = 1.0 / np.sqrt(1.0 + np.float32(shot / noise**2) * light)
    return result
