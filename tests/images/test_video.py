"""Videos: what is written is read, image by image, and a lost image is told."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.detection.spots.detector import find_spots
from urdfcal.errors import CameraError, OutputError
from urdfcal.images.files import Video, VideoFrame, write_video
from urdfcal.simulation.render import Light, Scenery, Sensor

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from urdfcal.detection.spots.detector import Spots
    from urdfcal.images.files import Image

SIZE, COUNT = (320, 256), 20
SENSOR = Sensor(SIZE, 8, 10.0)


def place(k: int) -> np.ndarray:
    return np.array([30.4 + 8.7 * k, 128.0 + 90.0 * np.sin(0.4 * k)])


def at_the_led(spots: Spots, at: list[int]) -> tuple[np.ndarray, list[str]]:
    """How far the good spots at the LED are from it (n, 2), and what is said of all that are there.

    Shadows of former images are lights as well, which the arm tells from the LED's.
    """
    apart = spots.fits.uv - [place(at[k]) for k in spots.image]
    there = np.flatnonzero(np.linalg.norm(apart, axis=1) < 2.0)
    return apart[[i for i in there if not spots.reasons[i]]], [spots.reasons[i] for i in there]


def images() -> Iterator[Image]:
    rng, wall = np.random.default_rng(0), Scenery.flat(SIZE, 25.0)
    for k in range(COUNT):
        yield SENSOR.expose(wall.expected([Light(place(k), 1500.0, 1.5)]), rng)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "cam.mp4"
    write_video(path, images(), SIZE, 30.0)
    return path


def test_every_picture_comes_back_in_order(path: Path) -> None:
    frames = [frame.lit(SIZE) for frame in Video(path, tuple(range(COUNT)), COUNT)]
    assert len(frames) == COUNT
    for k, (image, written) in enumerate(zip(frames, images(), strict=True)):
        assert image.shape == (*written.shape, 3)
        v, u = np.unravel_index(np.argmax(image.sum(axis=2)), written.shape)
        assert np.linalg.norm(place(k) - (u, v)) < 2.0


def test_some_pictures_are_passed_over_and_one_is_found(path: Path) -> None:
    rows = (3, 4, 11, 19)
    video = Video(path, rows, COUNT)
    for i, frame in enumerate(video):
        assert np.array_equal(frame.lit(SIZE), video[i].lit(SIZE))
        assert f"image {rows[i] + 1}" in frame.where


@pytest.mark.no_cover
@pytest.mark.parametrize("threads", [1, 3])
def test_leds_are_found_in_a_video_as_in_files(path: Path, threads: int) -> None:
    spots = find_spots(Video(path, tuple(range(COUNT)), COUNT), SIZE, threads=threads)
    miss, reasons = at_the_led(spots, list(range(COUNT)))
    # MPEG-4 leaves one spot in fifteen unround, and those are not taken.
    assert reasons.count("") > 0.85 * COUNT
    assert np.sqrt(np.mean(miss**2)) < 0.1


@pytest.mark.no_cover
def test_a_few_pictures_are_in_memory_at_a_time(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alive: weakref.WeakSet[VideoFrame] = weakref.WeakSet()
    most = 0

    class Counted(VideoFrame):
        def __init__(self, image: Image, where: str) -> None:
            nonlocal most
            super().__init__(image, where)
            alive.add(self)
            most = max(most, len(alive))

    monkeypatch.setattr("urdfcal.images.files.VideoFrame", Counted)
    find_spots(Video(path, tuple(range(COUNT)), COUNT), SIZE, threads=2, place=np.zeros(COUNT, dtype=np.intp))
    assert 1 <= most <= 6


@pytest.mark.no_cover
def test_an_arm_that_waits_is_no_lamp(tmp_path: Path) -> None:
    rng, wall = np.random.default_rng(0), Scenery.flat(SIZE, 25.0)
    at = [0] * 12 + list(range(8)) + [8] * 12 + list(range(9, 15)) + [15] * 20
    lights = [[Light(place(k), 1500.0, 1.5), Light(np.array([250.0, 40.0]), 1500.0, 1.5)] for k in at]
    write_video(tmp_path / "a.mp4", (SENSOR.expose(wall.expected(of), rng) for of in lights), SIZE, 30.0)
    spots = find_spots(Video(tmp_path / "a.mp4", tuple(range(len(at))), len(at)), SIZE, place=np.array(at))
    miss, reasons = at_the_led(spots, at)
    assert reasons.count("") > 0.85 * len(at)
    assert np.abs(miss).max() < 0.3
    assert "it stands still" not in reasons


@pytest.mark.parametrize("count", [COUNT - 2, COUNT + 5])
def test_a_count_that_differs_is_told_with_both_numbers(path: Path, count: int) -> None:
    with pytest.raises(CameraError, match=rf"has {COUNT} images, and the table of frames {count}"):
        find_spots(Video(path, tuple(range(count)), count), SIZE)


def test_another_size_and_what_is_no_video_are_told(path: Path, tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"320 x 256 px, the camera 640 x 512"):
        find_spots(Video(path, (0,), COUNT), (640, 512))
    (tmp_path / "bad.mp4").write_bytes(b"nothing")
    with pytest.raises(CameraError, match="no video"):
        list(Video(tmp_path / "bad.mp4", (0,), 1))
    with pytest.raises(OutputError):
        write_video(tmp_path / "nowhere" / "a.mp4", images(), SIZE, 30.0)
