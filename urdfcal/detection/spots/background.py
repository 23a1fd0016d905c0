"""What stands still in the pictures of one camera: lamps, windows, the wall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.detection.spots.candidates import Still, find_candidates, halved

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from urdfcal.arrays import Bools, Ints

# Pictures whose median is taken: the LED, and the arm before a lamp, may be in the same place in three of them.
SAMPLE = 7
# The median's own noise costs 10 % of accuracy where the background dominates: it is taken off only where the
# background differs by more than this many deviations of a picture's noise within a crop.
_STRUCTURE = 3.0
# Rounding hides noise below this. [counts]
_LEAST_NOISE = 0.3
# Shot noise is told from pixels this many deviations above the dark, if there are as many of them.
_BRIGHT, _ENOUGH = 20.0, 200


@dataclass(frozen=True, eq=False)
class Backdrop:
    """The median of some pictures.

    Attributes:
        values: (h, w) counts.
        still: what is to be taken off the images in which LEDs are searched; they differ for a coloured one.
        blind: (h, w) pixels that are clipped without the LED already.
        noise: of a picture where it is dark, one standard deviation. [counts]
        lights: (k, 2) pixels of the small lights in it.
    """

    values: NDArray[np.float32]
    still: Still
    blind: Bools
    noise: float
    lights: Ints

    @classmethod
    def of(
        cls,
        pictures: Sequence[NDArray[np.float32]],
        clipped: float,
        searched: Sequence[NDArray[np.float32]] | None = None,
    ) -> Backdrop:
        """Take the median of an odd number of ``pictures`` (h, w) in which a pixel of ``clipped`` may be clipped."""
        values = _median(pictures)
        change = pictures[0] - values
        noise = max(1.48 * float(np.median(np.abs(change[::5, ::5]))), _LEAST_NOISE)
        blind = values >= clipped
        image = values if searched is None else _median(searched)
        still = Still(image, halved(image), halved(_damping(values, change, blind, noise)))
        return cls(values, still, blind, noise, find_candidates(image).places)

    def off(self, crops: NDArray[np.float32], index: Any) -> NDArray[np.float32]:
        """Take it off ``crops`` (n, s, s) where it has structure; ``index`` cuts the same crops out of it."""
        here = self.values[index]
        # Means over 7 x 7 pixels, so that the median's noise is no structure.
        side = here.shape[1] // 7
        means = here[:, : 7 * side, : 7 * side].reshape(len(here), side, 7, side, 7).mean(axis=(2, 4))
        structured = np.ptp(means, axis=(1, 2)) > _STRUCTURE * self.noise
        return np.asarray(crops - np.where(structured[:, None, None], here, np.float32(0.0)))


def _median(pictures: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    middle = len(pictures) // 2
    result: NDArray[np.float32] = np.partition(np.stack(pictures), middle, axis=0)[middle]
    return result


def _damping(
    values: NDArray[np.float32], change: NDArray[np.float32], blind: Bools, noise: float
) -> NDArray[np.float32]:
    """Noise in the dark over that of each pixel, from how much lamps changed between two pictures."""
    light = np.maximum(values - np.median(values[::5, ::5]), np.float32(0.0))
    bright = (light > _BRIGHT * noise) & ~blind
    if np.count_nonzero(bright) < _ENOUGH:
        return np.ones_like(values)
    # Median, because the arm may have hidden a lamp.
    shot = (1.48 * float(np.median(np.abs(change[bright]) / np.sqrt(light[bright])))) ** 2
    result: NDArray[np.float32] = 1.0 / np.sqrt(1.0 + np.float32(shot / noise**2) * light)
    return result
