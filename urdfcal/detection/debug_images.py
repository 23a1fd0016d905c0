"""What was found in an image, drawn for a person to judge."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.images.files import channel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.detection.spots.detector import Spots
    from urdfcal.images.files import Colour, Image

_GREEN, _RED, _INK, _PAPER = (60, 220, 90), (255, 90, 80), (235, 235, 235), (24, 24, 28)
# A crop of this many pixels, each drawn this large; the image beside it has the same height.
_CROP, _ZOOM = 41, 16
_SIDE = _CROP * _ZOOM
_MOST_REASONS = 12


def draw_spots(image: Image, colour: Colour, spots: Spots, title: str) -> Image:
    """Draw the lights of one image: the whole of it with all of them, and the detection enlarged.

    Args:
        image: (h, w) or (h, w, 3), 8 or 16 bit.
        colour: whose channel was searched.
        spots: the lights; the good one is the detection.
        title: of the drawing.

    Returns:
        (h', w', 3) red first, 8 bit.
    """
    import cv2

    values = channel(image, colour)
    uv, sigma, reasons, good = spots.fits.uv, spots.fits.sigma, spots.reasons, np.flatnonzero(spots.good)
    height, width = values.shape
    scale = _SIDE / height
    small = cv2.resize(_visible(values), (round(width * scale), _SIDE), interpolation=cv2.INTER_AREA)
    whole = cv2.cvtColor(small, cv2.COLOR_GRAY2RGB)
    for i, reason in enumerate(reasons):
        x, y = (round((c + 0.5) * scale) for c in uv[i])
        ink, radius = (_RED, 9) if reason else (_GREEN, 13)
        cv2.circle(whole, (x, y), radius, ink, 1, cv2.LINE_AA)
        cv2.putText(whole, str(i), (x + 11, y - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.38, ink, 1, cv2.LINE_AA)
    closer = np.full((_SIDE, _SIDE, 3), _PAPER, np.uint8)
    if len(uv):
        closer = _enlarged(values, uv[good[0] if len(good) else 0], _GREEN if len(good) else _RED)
    lines = [title]
    lines += [f"{i}: u {uv[i, 0]:.3f}  v {uv[i, 1]:.3f}  +- {sigma[i]:.3f} px" for i in good]
    lines += [f"{i}: {reason}" for i, reason in enumerate(reasons) if reason]
    if len(lines) > _MOST_REASONS:
        lines = [*lines[:_MOST_REASONS], f"and {len(lines) - _MOST_REASONS} more"]
    images = np.hstack([whole, closer])
    legend = np.full((22 * len(lines) + 12, images.shape[1], 3), _PAPER, np.uint8)
    for row, text in enumerate(lines):
        ink = _INK if row == 0 else _GREEN if row <= len(good) else _RED
        cv2.putText(legend, text, (10, 22 * (row + 1)), cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, 1, cv2.LINE_AA)
    return np.vstack([legend, images])


def draw_points(image: Image, points: Sequence[tuple[str, Floats]], title: str) -> Image:
    """Draw the points of targets that were found in an image.

    Args:
        image: (h, w) or (h, w, 3), 8 or 16 bit.
        points: name of each, and (2,) where it is. [px]
        title: of the drawing.

    Returns:
        (h, w, 3) red first, 8 bit.
    """
    import cv2

    drawing = cv2.cvtColor(_visible(channel(image, "any")), cv2.COLOR_GRAY2RGB)
    for name, uv in points:
        x, y = (round(16.0 * c) for c in uv)  # OpenCV draws at sixteenths of a pixel
        cv2.circle(drawing, (x, y), 16 * 4, _GREEN, 1, cv2.LINE_AA, 4)
        at = (x // 16 + 5, y // 16 - 5)
        cv2.putText(drawing, name.partition(":")[2], at, cv2.FONT_HERSHEY_SIMPLEX, 0.35, _GREEN, 1, cv2.LINE_AA)
    text = f"{title}: {len(points)} points" if points else f"{title}: no target"
    cv2.putText(drawing, text, (10, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _GREEN if points else _RED, 1, cv2.LINE_AA)
    return np.asarray(drawing)


def _visible(values: Floats | Image) -> Image:
    """8 bit, dark things lifted: from the 1 % darkest to the brightest, square root."""
    low = float(np.percentile(values[::7, ::7], 1.0))
    span = max(float(values.max()) - low, 1.0)
    return np.asarray(255.0 * np.sqrt(np.clip((values - low) / span, 0.0, 1.0))).astype(np.uint8)


def _enlarged(values: Floats | Image, uv: Floats, ink: tuple[int, int, int]) -> Image:
    """The pixels around a light, with its centre drawn to a fraction of a pixel."""
    import cv2

    half = _CROP // 2
    padded = np.pad(values, half, mode="edge")
    u, v = np.clip(np.rint(uv).astype(int), 0, np.array(values.shape[::-1]) - 1)
    crop = _visible(padded[v : v + _CROP, u : u + _CROP])
    large = cv2.cvtColor(cv2.resize(crop, (_SIDE, _SIDE), interpolation=cv2.INTER_NEAREST), cv2.COLOR_GRAY2RGB)
    # OpenCV draws at sixteenths of a pixel.
    x, y = (round(16.0 * ((c - p + half + 0.5) * _ZOOM - 0.5)) for c, p in zip(uv, (u, v), strict=True))
    arm, gap = 16 * 60, 16 * 3
    for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        ends = (x + a * gap, y + b * gap), (x + a * arm, y + b * arm)
        cv2.line(large, *ends, ink, 1, cv2.LINE_AA, 4)
    return np.asarray(large)
