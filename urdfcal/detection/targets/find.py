"""The points of a target in one image, each with its covariance; or why there are none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.cameras.board.corners import Corners, refine, refine_marker
from urdfcal.cameras.board.detection import detect_board
from urdfcal.detection.targets.circles import find_circles
from urdfcal.detection.targets.tags import find_markers, modules_of
from urdfcal.images.files import channel, saturation
from urdfcal.session.pattern import ChessboardPattern, CirclesPattern, TagsPattern

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.cameras.camera import Camera
    from urdfcal.images.files import Image
    from urdfcal.session.pattern import Pattern
    from urdfcal.session.target import Target

# Points of the right target lie where its print has them; those of another lie pixels off. [px]
_MISFIT = 3.0
# Fewer points do not tell a pose.
_FEWEST = 4
# Small and soft markers are found in an image of twice the size.
_LARGER = 2
# An image is dark where its brightest percent is below this share of white, and glaring where so much of it is white.
_DARK, _GLARING = 0.1, 0.2
# The sharpest edges of an image in focus rise within a few pixels: contrast over two pixels and over 24.
_SOFT, _NEAR, _FAR = 0.25, 2, 24


@dataclass(frozen=True, eq=False)
class Found:
    """What one image shows of a target.

    Attributes:
        uv: (M, 2) its points, NaN where one was not found. [px]
        sigma: (M,) standard deviation of u and of v. [px]
        reason: why there are none; empty if there are.
    """

    uv: Floats
    sigma: Floats
    reason: str = ""

    @property
    def seen(self) -> int:
        """Number of points that were found."""
        return int(np.count_nonzero(np.isfinite(self.uv[:, 0])))


def find_target(image: Image, target: Target, camera: Camera) -> Found:
    """Find a target's points.

    Args:
        image: (h, w) or (h, w, 3), 8 or 16 bit.
        target: of a kind that is printed.
        camera: that took it.
    """
    corners = _corners(image, target.pattern)
    none = np.full((len(target.points), 2), np.nan), np.full(len(target.points), np.nan)
    if corners is None or np.count_nonzero(corners.found) < _FEWEST:
        few = "" if corners is None else f" {np.count_nonzero(corners.found)} points are too few;"
        return Found(*none, f"it is not found:{few} {_light(image)}")
    off = misfit(target.points, corners.uv, camera)
    if not off < _MISFIT:
        return Found(*none, f"what is found lies {off:.0f} px from where a target like this has its points")
    return Found(corners.uv, np.sqrt(np.trace(corners.covariance, axis1=1, axis2=2) / 2.0))


def misfit(points: Floats, uv: Floats, camera: Camera) -> float:
    """How far (median, px) points (M, 2), NaN where there are none, are from those of a target (M, 3) at its best pose.

    Infinite if there is no such pose.
    """
    import cv2

    rays = camera.unproject(uv)[:, :2]
    good = np.isfinite(rays[:, 0])
    flat = np.ptp(points[good][:, 2]) == 0.0 if good.any() else False
    method = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    try:
        found, rvec, tvec = cv2.solvePnP(points[good], rays[good], np.eye(3), None, flags=method)
    except cv2.error:  # too few, or on a line
        return np.inf
    if not found:
        return np.inf
    p_cam = points[good] @ cv2.Rodrigues(rvec)[0].T + tvec.ravel()
    return float(np.nan_to_num(np.median(np.linalg.norm(camera.project(p_cam) - uv[good], axis=1)), nan=np.inf))


def eight_bits(image: Image) -> Image:
    """Bring an image to grey and 8 bits; a few glaring pixels do not press the rest into the dark end."""
    grey = channel(image, "any")
    if image.shape == grey.shape and image.dtype == np.uint8:
        return image
    low, high = np.percentile(grey[::4, ::4], [1.0, 99.0])
    return np.asarray(np.clip((grey - low) * (235.0 / max(high - low, 1e-6)) + 10.0, 0, 255).astype(np.uint8))


def _corners(image: Image, pattern: Pattern) -> Corners | None:
    grey = channel(image, "any")
    if isinstance(pattern, ChessboardPattern):
        corners = detect_board(image, pattern.board)
        if pattern.kind == "charuco" and (corners is None or corners.found.sum() < len(corners.found)):
            larger = _twice(image)
            again = detect_board(larger, pattern.board)
            if again is not None and (corners is None or again.found.sum() > corners.found.sum()):
                corners = refine(grey, pattern.board, (again.uv - 0.5 * (_LARGER - 1)) / _LARGER)
        return corners
    if isinstance(pattern, TagsPattern):
        return _tags(image, grey, pattern)
    if isinstance(pattern, CirclesPattern):
        return find_circles(eight_bits(image), grey, pattern)
    return None


def _tags(image: Image, grey: Image, pattern: TagsPattern) -> Corners:
    eight = eight_bits(image)
    found = find_markers(eight, pattern.opencv)
    if set(pattern.tags) - set(found):
        larger = find_markers(_twice(eight), pattern.opencv)
        found = {n: (uv - 0.5 * (_LARGER - 1)) / _LARGER for n, uv in larger.items()} | found
    count = 4 * len(pattern.tags)
    result = Corners(np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan), np.full(count, np.nan))
    for k, number in enumerate(pattern.tags):
        if number in found:
            mine = slice(4 * k, 4 * k + 4)
            seen = refine_marker(grey, found[number], modules_of(pattern.opencv))
            result.uv[mine], result.covariance[mine], result.blur[mine] = seen.uv, seen.covariance, seen.blur
    return result


def _twice(image: Image) -> Image:
    import cv2

    return np.asarray(cv2.resize(image, None, fx=_LARGER, fy=_LARGER, interpolation=cv2.INTER_CUBIC))


def _light(image: Image) -> str:
    """Say what is wrong with an image's light or focus."""
    import cv2

    grey, white = channel(image, "any"), 255.0 if image.dtype == np.uint8 else float(max(saturation(image), 1.0))
    if np.percentile(grey[::4, ::4], 99.0) < _DARK * white:
        return "the image is dark"
    if np.mean(grey >= 0.98 * white) > _GLARING:
        return "the image is overexposed"
    smooth = cv2.blur(grey, (3, 3))
    near, far = (np.percentile(np.abs(smooth[:, step:] - smooth[:, :-step]), 99.9) for step in (_NEAR, _FAR))
    return "the image is blurred" if near < _SOFT * far else "the image is sharp and neither dark nor glaring"
