"""The chessboard pictures of the Debian package opencv-doc: spoilt copies, and what OpenCV makes of them.

Nothing of them is in this repository; `apt-get install opencv-doc` has them.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

FOLDER = Path("/usr/share/doc/opencv-doc/examples/data")
BOARD = ("--board", "chessboard", "9x6", "--square", "0.025")
SIDES = ("left", "right")

Copies = dict[str, dict[str, np.ndarray]]


def originals() -> Copies:
    """Side -> number -> picture; empty where the package is not installed."""
    return {
        side: {
            path.stem[len(side) :]: cv2.imread(str(path), 0) for path in sorted(FOLDER.glob(f"{side}[0-9][0-9].jpg"))
        }
        for side in SIDES
    }


def spoil(image: np.ndarray, how: str) -> np.ndarray:
    """A soft (blur of 3 px), dim (a quarter of the contrast) or small (half the size) copy, or several: "small+dim"."""
    for step in how.split("+"):
        if step == "soft":
            image = cv2.GaussianBlur(image, (0, 0), 3.0)
        elif step == "dim":
            image = np.rint(0.25 * image + 40.0).astype(np.uint8)
        elif step == "small":
            image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return image


def write(folder: Path, how: str) -> None:
    """Write folder/<side>/<number>.jpg of spoilt copies; "jpeg" in ``how``: of quality 30."""
    quality = 30 if "jpeg" in how else 95
    for side, pictures in originals().items():
        (folder / side).mkdir(parents=True)
        for number, image in pictures.items():
            cv2.imwrite(str(folder / side / f"{number}.jpg"), spoil(image, how), [cv2.IMWRITE_JPEG_QUALITY, quality])


def opencv() -> dict[str, float]:
    """OpenCV's reprojection error, px (both coordinates), of either camera and of the pair, as in its tutorial."""
    plane = np.zeros((54, 3), np.float32)
    plane[:, :2] = 0.025 * np.mgrid[0:9, 0:6].T.reshape(-1, 2)
    corners: dict[str, list[np.ndarray]] = {}
    for side, pictures in originals().items():
        corners[side] = []
        for image in pictures.values():
            found, rough = cv2.findChessboardCorners(image, (9, 6))
            assert found
            corners[side].append(cv2.cornerSubPix(image, rough, (11, 11), (-1, -1), (3, 30, 1e-3)))
    planes, size, errors, lenses = [plane] * len(corners["left"]), (640, 480), {}, []
    for side in SIDES:
        errors[side], *lens = cv2.calibrateCamera(planes, corners[side], size, None, None, flags=cv2.CALIB_FIX_K3)[:3]
        lenses += lens
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    errors["pair"] = cv2.stereoCalibrate(planes, *corners.values(), *lenses, size, flags=flags)[0]
    return errors
