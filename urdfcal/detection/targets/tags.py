"""Square markers in an image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.images.files import Image


def find_markers(image: Image, dictionary: str) -> dict[int, Floats]:
    """Find the markers of one of OpenCV's dictionaries in an 8-bit image.

    Args:
        image: (h, w), 8 bit.
        dictionary: OpenCV's name, such as DICT_APRILTAG_36h11.

    Returns:
        By number the corners (4, 2), clockwise from the top left, to a pixel. [px]
    """
    import cv2

    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)))
    corners, numbers, _ = detector.detectMarkers(image)
    if numbers is None:
        return {}
    return {int(n): np.reshape(uv, (4, 2)).astype(float) for n, uv in zip(np.ravel(numbers), corners, strict=True)}


def modules_of(dictionary: str) -> int:
    """Return the number of modules along a marker's side, the black border included."""
    import cv2

    return int(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)).markerSize) + 2
