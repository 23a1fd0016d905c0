"""Grids of dots in an image: the images of their centres, which are not the centres of their images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.cameras.board.corners import Corners

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.images.files import Image
    from urdfcal.session.pattern import CirclesPattern

# Pixels around a dot that its centroid is taken over, in its radii: its blur is within, the next dot is not.
_REACH = 1.5
_FEWEST_PIXELS = 12
# Share of a further row that is dark with paper behind it: of a grid's own margin none is, of its next row all.
_GOES_ON = 0.5
# Dots of less contrast to the paper are no dots, in standard deviations of the paper's pixels.
_CONTRAST = 6.0


def find_circles(image: Image, grey: Image, pattern: CirclesPattern) -> Corners | None:
    """Find a grid of black dots.

    A dot's centroid is that of an ellipse; the centre of the circle is seen elsewhere, by what the homography of the
    grid and the dot's size say (Heikkila 2000).

    Args:
        image: (h, w), 8 bit.
        grey: (h, w) the same as it is.
        pattern: the grid.

    Returns:
        The centres in the pattern's order; None where the grid is not found.
    """
    import cv2

    flags = cv2.CALIB_CB_ASYMMETRIC_GRID if pattern.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    found, centres = cv2.findCirclesGrid(image, pattern.size, flags=flags | cv2.CALIB_CB_CLUSTERING)
    if not found:
        found, centres = cv2.findCirclesGrid(image, pattern.size, flags=flags)
    if not found:
        return None
    uv = np.reshape(centres, (-1, 2)).astype(float)
    points = np.array(list(pattern.points.values()))[:, :2]
    H, _ = cv2.findHomography(points, uv)
    right, below = H[:2, :2].T
    if right[0] * below[1] - right[1] * below[0] < 0.0:  # seen from the front, x right of y
        uv = uv.reshape(pattern.size[1], pattern.size[0], 2)[:, ::-1].reshape(-1, 2)
        H, _ = cv2.findHomography(points, uv)
    if _goes_on(grey, H, pattern):
        return None
    result = Corners(np.full_like(uv, np.nan), np.full((len(uv), 2, 2), np.nan), np.full(len(uv), np.nan))
    for k, point in enumerate(points):
        _dot(grey, uv[k], H, point, pattern.spacing, result, k)
    return result


def _goes_on(grey: Image, H: Floats, pattern: CirclesPattern) -> bool:
    """Whether there are dots where a larger grid has its next row or column: of such a one a part would be found."""
    across, down = pattern.size

    def levels(i: Floats, j: Floats) -> Floats:
        x = 2.0 * i + j % 2.0 if pattern.asymmetric else i
        p = np.stack([pattern.spacing * x, pattern.spacing * j, np.ones_like(x)]).reshape(3, -1)
        u, v = np.rint((H @ p)[:2] / (H @ p)[2]).astype(int)
        height, width = grey.shape
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        result: Floats = np.where(inside, grey[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], np.nan)
        return result

    i, j = (of.astype(float) for of in np.meshgrid(np.arange(across), np.arange(down)))
    between = 0.0 if pattern.asymmetric else 0.5
    dark = 0.5 * (np.nanmedian(levels(i, j)) + np.nanmedian(levels(i + 0.5, j + between)))
    rows, columns = np.arange(down, dtype=float), np.arange(across, dtype=float)
    sides = [((at + 0.0 * rows, rows), (out + 0.0 * rows, rows)) for at, out in ((-1.0, -1.5), (across, across + 0.5))]
    for at, out in ((-1.0, -1.5), (down, down + 0.5)):
        sides.append(((columns, at + 0.0 * columns), (columns, out + 0.0 * columns)))
    return any(np.mean((levels(*dots) < dark) & (levels(*behind) > dark)) > _GOES_ON for dots, behind in sides)


def _dot(grey: Image, near: Floats, H: Floats, point: Floats, spacing: float, result: Corners, k: int) -> None:
    """Take a dot's centroid, its covariance, and the shift of its ellipse."""
    scale = np.sqrt(abs(np.linalg.det(_derivative(H, point))))
    half = int(np.ceil(0.5 * spacing * scale))
    u, v = np.rint(near).astype(int)
    rows, columns = slice(v - half, v + half + 1), slice(u - half, u + half + 1)
    window = grey[rows, columns].astype(float)
    if min(u, v) < half or window.shape != (2 * half + 1, 2 * half + 1) or window.size < _FEWEST_PIXELS:
        return
    white, ink = np.percentile(window, 90.0), np.percentile(window, 5.0)
    bright = window[window > white - 0.2 * (white - ink)]
    paper, noise = float(np.median(bright)), max(1.4826 * float(np.median(np.abs(bright - np.median(bright)))), 0.3)
    if paper - ink < _CONTRAST * noise:
        return
    y, x = np.indices(window.shape) - half
    area = float(np.sum(np.clip((paper - window) / (paper - ink), 0.0, 1.0)))
    radius = np.sqrt(area / np.pi)
    near_by = np.hypot(x + u - near[0], y + v - near[1]) < _REACH * radius + 2.0
    weight = np.where(near_by, paper - window, 0.0)
    total = float(weight.sum())
    centre = np.array([np.sum(weight * x), np.sum(weight * y)]) / total
    spread = np.array([[np.sum(near_by * (a - ca) * (b - cb)) for b, cb in ((x, centre[0]), (y, centre[1]))]
                       for a, ca in ((x, centre[0]), (y, centre[1]))])  # fmt: skip
    result.uv[k] = centre + np.array([u, v]) - _eccentricity(H, point, radius / scale)
    result.covariance[k] = noise**2 * spread / total**2
    result.blur[k] = 0.0


def _eccentricity(H: Floats, point: Floats, radius: float) -> Floats:
    """How far (2,) the centre of a circle's image lies from the image of its centre. [px]."""
    T = np.array([[1.0, 0.0, point[0]], [0.0, 1.0, point[1]], [0.0, 0.0, 1.0]])
    back = np.linalg.inv(H @ T)
    conic = np.linalg.inv(back.T @ np.diag([1.0, 1.0, -(radius**2)]) @ back)
    centre = conic[:2, 2] / conic[2, 2]
    true = (H @ [*point, 1.0])[:2] / (H @ [*point, 1.0])[2]
    return np.asarray(centre - true)


def _derivative(H: Floats, point: Floats) -> Floats:
    x, y, w = H @ [*point, 1.0]
    return np.asarray((H[:2, :2] - np.outer([x / w, y / w], H[2, :2])) / w)
