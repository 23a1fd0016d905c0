"""Pixels as ROS messages hold them (sensor_msgs/Image and CompressedImage), to images."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import CameraError

if TYPE_CHECKING:
    from urdfcal.images.files import Image

_MONO, _RGB, _BGR = [0], [0, 1, 2], [2, 1, 0]
# By name in sensor_msgs/image_encodings.hpp: bits a value, values a pixel, and those taken, red first. 8UC1 and 8UC3
# are OpenCV's own names, which cv_bridge writes for an array without a name; OpenCV's order is blue first.
# 16UC1 is not among them: by REP 118 it is a depth in mm.
_ENCODINGS = {
    "mono8": (8, 1, _MONO), "mono16": (16, 1, _MONO), "8UC1": (8, 1, _MONO),
    "rgb8": (8, 3, _RGB), "rgb16": (16, 3, _RGB), "rgba8": (8, 4, _RGB), "rgba16": (16, 4, _RGB),
    "bgr8": (8, 3, _BGR), "bgr16": (16, 3, _BGR), "bgra8": (8, 4, _BGR), "bgra16": (16, 4, _BGR), "8UC3": (8, 3, _BGR),
}  # fmt: skip
_BAYER = re.compile(r"bayer_(rggb|bggr|gbrg|grbg)(8|16)")
# The first bytes of files that a session holds as they are, and how such files are called.
_JPEG, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_FILES = {_JPEG: ".jpg", b"\x89PNG\r\n\x1a\n": ".png"}


class DamagedPictureError(CameraError):
    """One image that was not recorded whole; the next may be."""


def decode_raw(encoding: str, size: tuple[int, int], step: int, data: Image, *, big_endian: bool) -> Image:
    """The image in a sensor_msgs/Image: (h, w) or, red first, (h, w, 3); 8 or 16 bit.

    A transparency is left out. Bayer mosaics get their colours by OpenCV's bilinear interpolation.

    Args:
        encoding: its name, as ``bgr8``.
        size: (width, height) in px.
        step: bytes from row to row; what is more than a row's pixels is padding.
        data: all rows.
        big_endian: whether of 16 bits the upper ones come first.

    Raises:
        CameraError: the encoding is not known, or the size of the data is not what the rest says.
    """
    bayer = _BAYER.fullmatch(encoding)
    if bayer is None and encoding not in _ENCODINGS:
        known = ", ".join([*_ENCODINGS, "bayer_rggb8 and its like"])
        raise CameraError(f"images encoded as {encoding!r} are not supported", remedy=f"These are: {known}.")
    bits, values, taken = (int(bayer[2]), 1, _MONO) if bayer else _ENCODINGS[encoding]
    width, height = size
    row = width * values * bits // 8
    if min(size) <= 0 or step < row or len(data) != height * step:
        what = f"{len(data)} bytes in rows of {step} are no {encoding} image of {width} x {height} pixels"
        raise CameraError(what, remedy=f"{height} rows of {max(row, 0)} bytes or more are expected.")
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :row])
    kind = np.dtype(np.uint8) if bits == 8 else np.dtype(">u2" if big_endian else "<u2")
    pixels = rows.view(kind).reshape(height, width, values)[..., taken].astype(kind.newbyteorder("="))
    if bayer:
        return _demosaic(pixels[..., 0], bayer[1])
    return pixels[..., 0] if values == 1 else pixels


def decode_compressed(format_: str, data: bytes) -> tuple[str, Image | None, tuple[int, int]]:
    """What to keep of a sensor_msgs/CompressedImage.

    Args:
        format_: its format: ``jpeg``, or ``bgr8; jpeg compressed bgr8`` and the like.
        data: the compressed image.

    Returns:
        The suffix of a file for it, the image if the data is not to be kept as it is, and (width, height) in px.

    Raises:
        CameraError: it is a depth image.
        DamagedPictureError: it cannot be decoded, or its end is missing.
    """
    import cv2

    if "compressedDepth" in format_:
        raise CameraError(f"images of the format {format_!r} are distances, not brightnesses")
    # OpenCV decodes what there is of a JPEG; some cameras fill up with zeros after its end.
    cut = data.startswith(_JPEG) and not data.rstrip(b"\0").endswith(_JPEG_END)
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data and not cut else None
    if pixels is None:
        raise DamagedPictureError(f"{len(data)} bytes of the format {format_!r} are no whole image")
    size = pixels.shape[1], pixels.shape[0]
    # The mosaic of a Bayer sensor is compressed as if it were grey.
    bayer = _BAYER.match(format_)
    if bayer and pixels.ndim == 2:
        return ".png", _demosaic(pixels, bayer[1]), size
    for beginning, suffix in _FILES.items():
        if data.startswith(beginning):
            return suffix, None, size
    return ".png", pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., 2::-1]), size


def _demosaic(mosaic: Image, pattern: str) -> Image:
    import cv2

    if min(mosaic.shape) < 3:
        raise CameraError(f"a mosaic of {mosaic.shape[1]} x {mosaic.shape[0]} pixels has no colours")
    return np.asarray(cv2.cvtColor(mosaic, getattr(cv2, f"COLOR_Bayer{pattern.upper()}2RGB")))
