"""Reading images."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from urdfcal.errors import CameraError
from urdfcal.images.files import channel, in_parallel, read_image, saturation, write_image

if TYPE_CHECKING:
    from pathlib import Path


def noise(shape: tuple[int, ...], dtype: type) -> np.ndarray:
    return np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_every_depth_and_colour_is_read_as_written_red_first(
    tmp_path: Path, suffix: str, dtype: type, channels: int
) -> None:
    image = noise((20, 30) if channels == 1 else (20, 30, channels), dtype)
    path = tmp_path / f"Bild ä{suffix}"
    path.write_bytes(cv2.imencode(suffix, image)[1].tobytes())
    expected = image if channels == 1 else image[..., 2::-1]
    assert np.array_equal(read_image(path), expected)


@pytest.mark.parametrize("shape", [(20, 30), (20, 30, 3)])
def test_written_images_are_read_back(tmp_path: Path, shape: tuple[int, ...]) -> None:
    image = noise(shape, np.uint16)
    write_image(tmp_path / "a.png", image)
    assert np.array_equal(read_image(tmp_path / "a.png"), image)


def test_jpeg_is_read(tmp_path: Path) -> None:
    image = np.full((32, 32), 77, np.uint8)
    (tmp_path / "a.jpg").write_bytes(cv2.imencode(".jpg", image)[1].tobytes())
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - 77).max() <= 1


@pytest.mark.parametrize("data", [b"", b"not an image", b"\x89PNG\r\n\x1a\n\x00"])
def test_what_is_no_image_is_refused_by_name(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(CameraError, match=r"a\.png: this is no image"):
        read_image(tmp_path / "a.png")


def test_a_missing_file_and_floating_point_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="cannot be read"):
        read_image(tmp_path / "b.png")
    (tmp_path / "a.tif").write_bytes(cv2.imencode(".tif", np.ones((4, 4), np.float32))[1].tobytes())
    with pytest.raises(CameraError, match="float32"):
        read_image(tmp_path / "a.tif")


def test_channels() -> None:
    image = noise((6, 5, 3), np.uint8)
    assert np.array_equal(channel(image, "green"), image[..., 1])
    assert channel(image, "any") == pytest.approx(image.mean(axis=2), abs=0.51)
    assert np.array_equal(channel(image[..., 0], "red"), image[..., 0])


@pytest.mark.parametrize(
    ("dtype", "top", "shared", "level"),
    [
        (np.uint8, 255, 1, 255),
        (np.uint8, 250, 9, 250),
        (np.uint8, 120, 9, 255),
        (np.uint16, 900, 1, 1023),
        (np.uint16, 4095, 9, 4095),
        (np.uint16, 65520, 9, 65520),
        (np.uint16, 30000, 1, 65535),
    ],
)
def test_the_end_of_the_range_is_told_from_depth_and_from_pixels_that_share_it(
    dtype: type, top: int, shared: int, level: int
) -> None:
    image = np.zeros((8, 8), dtype)
    image.flat[:shared] = top
    assert saturation(image) == pytest.approx(level, rel=0.011)
    assert saturation(image) <= level


def test_parallel_results_come_in_order_and_never_far_ahead_of_the_reader() -> None:
    started: list[int] = []
    lock = threading.Lock()

    def work(i: int) -> int:
        with lock:
            started.append(i)
        time.sleep(0.001 * (i % 3))
        return i * i

    seen = []
    for result in in_parallel(work, range(40), threads=3):
        seen.append(result)
        assert len(started) <= len(seen) + 6
    assert seen == [i * i for i in range(40)]


def test_an_error_in_a_thread_reaches_the_reader() -> None:
    def work(i: int) -> int:
        if i == 5:
            raise CameraError("five")
        return i

    with pytest.raises(CameraError, match="five"):
        list(in_parallel(work, range(40), threads=2))
