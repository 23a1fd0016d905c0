"""The colours that mean the same in every view."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from urdfcal.arrays import Floats

CALIBRATED = (60, 210, 150)
NOMINAL = (95, 145, 255)
GHOST = (*NOMINAL, 60)
MEASURED = (255, 255, 255)
OUTLIER = (230, 60, 230)
FAINT = (150, 150, 120)

_SIGMAS = (1.0, 2.5, 5.0)
_COLORS = ((60, 200, 90), (240, 210, 60), (230, 50, 50))
SIGMA_LEGEND = "green: within the noise, yellow: 2.5 times it, red: 5 times it or more"


def by_sigma(size: Floats) -> NDArray[np.uint8]:
    """Colour residuals by their size in standard deviations, (M,) -> (M, 3)."""
    size = np.nan_to_num(size, nan=np.inf)  # not predictable at all: behind the camera
    channels = [np.interp(size, _SIGMAS, channel) for channel in zip(*_COLORS, strict=True)]
    return np.stack(channels, axis=-1).astype(np.uint8)
