"""Colours that mean the same in every view."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from urdfcal.arrays import Floats

CALIBRATED = (60, 210, 150)
NOMINAL = (95, 145, 255)
OF_ARM = {"nominal": NOMINAL, "calibrated": CALIBRATED}
GHOST = (*NOMINAL, 60)
MEASURED = (255, 255, 255)
OUTLIER = (230, 60, 230)
ACCENT = (214, 140, 40)
"""What joints do beside their geometry, and tolerances: neither arm, and no outlier."""
REJECTED = (255, 170, 80)
"""Lights in images that are no LED."""
FAINT = (150, 150, 120)
INK = (150, 150, 150)
"""Of labels, which the viewer writes on dark or light ground as the user likes it."""
GRID = (48, 50, 54)
UNMEASURED = (205, 205, 205)
"""Of cells on paper where nothing was measured."""
BACKGROUND = (13, 14, 16)
SPACE = (50, 53, 58)
"""Behind the arm, whose links may be black."""
COMPONENTS = ((90, 200, 250), (255, 170, 80), (200, 140, 255))
"""u and v, or x, y and z."""
PARAMETER_COLORS = {
    "theta": (90, 200, 250),
    "d": (110, 130, 255),
    "a": (255, 95, 95),
    "alpha": (255, 170, 80),
    "beta": (200, 140, 255),
    "x": (255, 95, 95),
    "y": (110, 220, 110),
    "z": (110, 130, 255),
    "rx": (255, 170, 80),
    "ry": (200, 140, 255),
    "rz": (90, 200, 250),
}
VERDICT_COLORS = {"good": (20, 110, 70), "doubtful": (165, 110, 0), "bad": (165, 30, 30)}

_SIGMAS = (1.0, 2.5, 5.0)
_COLORS = ((60, 200, 90), (240, 210, 60), (230, 50, 50))
SIGMA_LEGEND = "green: within the noise, yellow: 2.5 times it, red: 5 times it or more"


def by_sigma(size: Floats) -> NDArray[np.uint8]:
    """Colour residuals by their size in standard deviations, (M,) -> (M, 3)."""
    size = np.nan_to_num(size, nan=np.inf)  # not predictable at all: behind the camera
    return _between(size, _SIGMAS, _COLORS)


def viridis(share: Floats) -> NDArray[np.uint8]:
    """Colours from dark violet at 0 to yellow at 1, (M,) -> (M, 3)."""
    share = np.nan_to_num(share)  # of no errors at all there is no scale
    return _between(share, np.linspace(0.0, 1.0, len(_VIRIDIS)), _VIRIDIS)


def _between(values: Floats, stops: Sequence[float] | Floats, colors: tuple[tuple[int, ...], ...]) -> NDArray[np.uint8]:
    channels = [np.interp(values, stops, channel) for channel in zip(*colors, strict=True)]
    return np.stack(channels, axis=-1).astype(np.uint8)


# Of matplotlib's viridis, which loses its order to no kind of colour blindness.
_VIRIDIS = ((72, 36, 117), (65, 68, 135), (53, 95, 141), (42, 120, 142), (33, 145, 140), (34, 168, 132), (68, 191, 112),
            (122, 209, 81), (189, 223, 38), (253, 231, 37))  # fmt: skip
