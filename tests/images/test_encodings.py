from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from urdfcal.errors import CameraError
from urdfcal.images.encodings import decode_compressed, decode_raw

# What each stands for, by its documentation: the place of red, green and blue among the values of a pixel.
ORDERS = {
    "mono8": "k", "mono16": "k", "8UC1": "k", "rgb8": "rgb", "rgb16": "rgb", "rgba8": "rgba", "rgba16": "rgba",
    "bgr8": "bgr", "bgr16": "bgr", "bgra8": "bgra", "bgra16": "bgra", "8UC3": "bgr",
}  # fmt: skip


def bits(encoding: str) -> int:
    return 16 if encoding.endswith("16") else 8


@given(
    encoding=st.sampled_from(sorted(ORDERS)),
    width=st.integers(1, 9),
    height=st.integers(1, 9),
    padding=st.integers(0, 5),
    big_endian=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_every_pixel_comes_back(
    encoding: str, width: int, height: int, padding: int, big_endian: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    order, depth = ORDERS[encoding], bits(encoding)
    pixels = rng.integers(0, 2**depth, (height, width, len(order)))
    stored = pixels.astype("u1" if depth == 8 else ">u2" if big_endian else "<u2")
    rows = np.frombuffer(stored.tobytes(), np.uint8).reshape(height, -1)
    rows = np.hstack([rows, rng.integers(0, 256, (height, padding), np.uint8)])
    image = decode_raw(encoding, (width, height), rows.shape[1], rows.ravel(), big_endian=big_endian)
    assert image.dtype == (np.uint8 if depth == 8 else np.uint16)
    expected = pixels[..., 0] if order == "k" else pixels[..., [order.index(c) for c in "rgb"]]
    np.testing.assert_array_equal(image, expected)


def mosaic_of(image: np.ndarray, pattern: str) -> np.ndarray:
    """What a sensor under a Bayer filter sees."""
    v, u = np.indices(image.shape[:2])
    channel = np.array(["rgb".index(c) for c in pattern])[(v % 2) * 2 + u % 2]
    return np.take_along_axis(image, channel[..., None], axis=2)[..., 0]


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("depth", [8, 16])
def test_a_mosaic_gets_its_colours_back(pattern: str, depth: int) -> None:
    # Linear in u and v: bilinear interpolation is exact away from the edge.
    v, u = np.indices((12, 10))
    image = np.stack([10 + 2 * u, 100 + 4 * v, 200 - 2 * u - 2 * v], axis=2).astype(f"u{depth // 8}") * (depth // 8)
    mosaic = mosaic_of(image, pattern)
    data = np.frombuffer(mosaic.tobytes(), np.uint8)
    result = decode_raw(f"bayer_{pattern}{depth}", (10, 12), 10 * depth // 8, data, big_endian=False)
    np.testing.assert_array_equal(result[1:-1, 1:-1], image[1:-1, 1:-1])
    suffix, compressed, size = decode_compressed(
        f"bayer_{pattern}{depth}; png compressed ", cv2.imencode(".png", mosaic)[1].tobytes()
    )
    assert (suffix, size) == (".png", (10, 12))
    np.testing.assert_array_equal(compressed, result)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "yuv422", "bayer_rggb", "BGR8", "", "mono8 "])
def test_unknown_encodings_are_refused_by_name(encoding: str) -> None:
    with pytest.raises(CameraError, match=f"'{encoding}' are not supported"):
        decode_raw(encoding, (2, 2), 8, np.zeros(16, np.uint8), big_endian=False)


@pytest.mark.parametrize(
    ("size", "step", "length"), [((4, 3), 11, 33), ((4, 3), 12, 35), ((4, 3), 12, 37), ((0, 3), 0, 0), ((4, 0), 12, 0)]
)
def test_data_of_another_size_is_refused(size: tuple[int, int], step: int, length: int) -> None:
    with pytest.raises(CameraError, match=f"{length} bytes in rows of {step} are no rgb8 image"):
        decode_raw("rgb8", size, step, np.zeros(length, np.uint8), big_endian=False)


@pytest.mark.parametrize(("suffix", "format_"), [(".jpg", "jpeg"), (".png", "bgr8; png compressed bgr8")])
def test_png_and_jpeg_are_kept_as_they_are(suffix: str, format_: str) -> None:
    data = cv2.imencode(suffix, np.full((5, 7, 3), (10, 20, 200), np.uint8))[1].tobytes()
    assert decode_compressed(format_, data) == (suffix, None, (7, 5))


def test_other_files_are_decoded() -> None:
    image = np.random.default_rng(0).integers(0, 2**16, (5, 7, 3), np.uint16)
    suffix, pixels, size = decode_compressed("rgb16; tiff compressed", cv2.imencode(".tiff", image)[1].tobytes())
    assert (suffix, size) == (".png", (7, 5))
    np.testing.assert_array_equal(pixels, image[..., ::-1])


@pytest.mark.parametrize(
    ("format_", "data", "message"),
    [
        ("16UC1; compressedDepth png", b"x" * 20, "distances"),
        ("jpeg", b"", "0 bytes of the format 'jpeg' are no whole image"),
        ("jpeg", b"\xff\xd8\xff broken", "no whole image"),
        ("jpeg", cv2.imencode(".jpg", np.eye(64, dtype=np.uint8) * 255)[1].tobytes()[:-20], "no whole image"),
        ("png", cv2.imencode(".png", np.eye(64, dtype=np.uint8) * 255)[1].tobytes()[:60], "no whole image"),
    ],
)
def test_what_is_no_image_is_refused(format_: str, data: bytes, message: str) -> None:
    with pytest.raises(CameraError, match=message):
        decode_compressed(format_, data)
