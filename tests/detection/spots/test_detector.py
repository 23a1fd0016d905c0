"""Finding and measuring LEDs, on rendered images whose truth is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.centroid_bound import centroid_bound
from urdfcal.detection.spots import gaussian
from urdfcal.detection.spots.centroid import HALF, Crops, Fits, fit_spots
from urdfcal.detection.spots.detector import Spots, find_spots
from urdfcal.errors import CameraError
from urdfcal.images.files import ImageFile, write_image
from urdfcal.simulation.render import Light, Scenery, Sensor

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

SIDE = 2 * HALF + 1
SIZE = (240, 180)
SENSOR = Sensor(SIZE, 8, 8.0)


def fitted(
    sensor: Sensor,
    peak: float,
    sigma: float,
    places: np.ndarray,
    slope: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
) -> Fits:
    rng = np.random.default_rng(seed)
    scenery = Scenery.flat((SIDE, SIDE), 15.0, slope)
    values = np.array([sensor.expose(scenery.expected([Light(HALF + p, peak, sigma)]), rng) for p in places])
    flat = np.ones(values.shape, dtype=bool)
    return fit_spots(
        Crops(np.zeros((len(places), 2), np.intp), values.astype(np.float32), flat, values >= sensor.white)
    )


def sensor_for(peak: float, saturated: float = 0.0, bits: int = 8) -> Sensor:
    full = peak / saturated if saturated else 1.3 * (peak + 15.0)
    return Sensor((SIDE, SIDE), bits, full / (2**bits - 5.0))


@pytest.mark.parametrize(("sigma", "peak"), [(1.0, 100.0), (1.5, 40.0), (2.0, 4000.0), (3.0, 400.0)])
def test_centroids_reach_the_bound_and_say_how_good_they_are(sigma: float, peak: float) -> None:
    places = np.random.default_rng(1).uniform(-0.5, 0.5, (300, 2))
    sensor = sensor_for(peak)
    fits = fitted(sensor, peak, sigma, places)
    assert fits.found.all()
    error = fits.uv - places
    bound = centroid_bound(sensor, Light(np.zeros(2), peak, sigma), 15.0)
    assert np.sqrt(np.mean(error**2)) < 1.2 * bound
    assert np.sqrt(np.mean((error / fits.sigma[:, None]) ** 2)) == pytest.approx(1.0, abs=0.15)
    assert np.median(fits.width) == pytest.approx(sigma, rel=0.03)


@pytest.mark.parametrize("sigma", [1.0, 3.0])
def test_a_spot_saturated_four_times_is_found_to_a_twentieth_of_a_pixel(sigma: float) -> None:
    places = np.random.default_rng(2).uniform(-0.5, 0.5, (100, 2))
    fits = fitted(sensor_for(4000.0, 4.0), 4000.0, sigma, places)
    assert np.sqrt(np.mean((fits.uv - places) ** 2)) < 0.05
    assert (fits.saturated > 5).all()


@pytest.mark.parametrize("saturated", [150.0, 1000.0])
def test_an_led_before_the_lens_that_shows_nothing_of_its_peak_is_found(saturated: float) -> None:
    places = np.random.default_rng(3).uniform(-0.5, 0.5, (100, 2))
    fits = fitted(sensor_for(390000.0, saturated), 390000.0, 1.5, places)
    assert fits.found.all()
    assert np.sqrt(np.mean((fits.uv - places) ** 2)) < 0.02


@pytest.mark.parametrize("saturated", [0.0, 4.0])
def test_neither_the_pixel_grid_nor_a_slope_moves_the_centroid(saturated: float) -> None:
    grid = np.linspace(-0.5, 0.5, 5)
    places = np.repeat(np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2), 30, axis=0)
    fits = fitted(sensor_for(4000.0, saturated, bits=16), 4000.0, 1.0, places, slope=(2.0, -1.0))
    bias = (fits.uv - places).reshape(25, 30, 2).mean(axis=1)
    assert np.abs(bias).max() < 0.01


def test_derivatives_of_the_spot_agree_with_finite_differences() -> None:
    axis = np.arange(-6.0, 7.0)
    u, v = np.tile(axis, 13), np.repeat(axis, 13)
    windows = gaussian.Windows(u, v, np.zeros((1, 169)), np.ones((1, 169), bool), np.zeros((1, 169), bool))
    spots = np.array([[0.3, -0.4, 80.0, 0.6, 0.15, 0.8, 5.0, 0.2, -0.1]])
    _, J = gaussian.jacobian(windows, spots)
    for k in range(gaussian.COUNT):
        step = np.zeros(gaussian.COUNT)
        step[k] = 1e-6
        change = gaussian.residuals(windows, spots - step) - gaussian.residuals(windows, spots + step)
        assert J[0, k] == pytest.approx(change[0] / 2e-6, rel=1e-6, abs=1e-6)


def spots_in(folder: Path, exposures: Sequence[Sequence[Light]], seed: int = 0, **scenery: object) -> Spots:
    rng = np.random.default_rng(seed)
    stage = Scenery.flat(SIZE, 25.0, **scenery)
    images = []
    for k, lights in enumerate(exposures):
        images.append(ImageFile(folder / f"{k}.png"))
        write_image(images[-1].path, SENSOR.expose(stage.expected(lights), rng))
    return find_spots(images, SIZE)


def reasons(spots: Spots, near: Sequence[float], within: float = 3.0) -> set[str]:
    rows = np.flatnonzero(np.linalg.norm(spots.fits.uv - near, axis=1) < within)
    return {spots.reasons[i] for i in rows}


def led(u: float, v: float, peak: float = 1000.0, motion: Sequence[float] = (0.0, 0.0)) -> Light:
    return Light(np.array([u, v]), peak, 1.5, np.array(motion))


def test_one_led_is_one_sighting(tmp_path: Path) -> None:
    spots = spots_in(tmp_path, [[led(100.3, 80.7)]])
    assert spots.good.sum() == 1
    assert spots.fits.uv[spots.good][0] == pytest.approx([100.3, 80.7], abs=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_an_empty_picture_has_no_sighting(tmp_path: Path, seed: int) -> None:
    assert not spots_in(tmp_path, [[]], seed=seed).good.any()


@pytest.mark.parametrize(
    ("light", "reason"),
    [
        ([led(100.0, 80.0, motion=(14.0, 4.0))], "elongated"),
        ([led(100.0, 80.0), led(104.5, 80.0, 600.0)], "elongated"),
        ([led(100.0, 80.0), led(107.0, 80.0, 300.0)], "another light"),
        ([Light(np.array([100.0, 80.0]), 1000.0, 14.0)], "larger"),
        ([led(0.5, 80.0)], "border"),
    ],
)
def test_what_is_no_single_round_spot_is_rejected_with_its_reason(
    tmp_path: Path, light: list[Light], reason: str
) -> None:
    spots = spots_in(tmp_path, [light])
    assert not spots.good.any()
    assert any(reason in text for text in spots.reasons)


def test_hot_pixels_are_no_leds_and_do_not_disturb_one(tmp_path: Path) -> None:
    hot = np.array([[50, 60], [103, 80], [102, 86]])
    spots = spots_in(tmp_path, [[led(100.3, 80.7)]], hot=hot, leak=np.array([900.0, 500.0, 3000.0]))
    assert reasons(spots, (50, 60)) == {"a hot pixel"}
    assert spots.good.sum() == 1
    assert spots.fits.uv[spots.good][0] == pytest.approx([100.3, 80.7], abs=0.12)


def test_leds_elsewhere_in_each_image_are_no_lights_that_stand_still(tmp_path: Path) -> None:
    places = np.random.default_rng(0).uniform([30, 30], [210, 150], (7, 2))
    images = [[led(*place, 4000.0)] for place in [*places, places[0]]]  # in the sample's median each leaves a trace
    spots = spots_in(tmp_path, images)
    assert spots.good.sum() == len(images)
    assert len(spots.still) == 0


def test_a_lamp_that_stands_still_is_none_and_an_led_in_its_light_is_found(tmp_path: Path) -> None:
    lamps = [led(60.0, 60.0, 1800.0), Light(np.array([150.0, 90.0]), 6000.0, 9.0)]
    rng = np.random.default_rng(3)
    places = [*rng.uniform([30, 30], [210, 150], (11, 2)), np.array([170.2, 104.6])]
    spots = spots_in(tmp_path, [[led(*place)] for place in places], lights=lamps)
    assert len(spots.still) >= 1
    for k, place in enumerate(places):
        found = spots.fits.uv[spots.good & (spots.image == k)]
        drowned = np.linalg.norm(place - [150.0, 90.0]) < 20.0 or np.linalg.norm(place - [60.0, 60.0]) < 12.0
        assert drowned or (len(found) == 1 and found[0] == pytest.approx(place, abs=0.3))
        assert all(np.linalg.norm(uv - place) < 0.5 for uv in found)
    assert spots.good[spots.image == 11].sum() == 1


def test_in_few_pictures_too_a_still_light_is_told_from_the_led(tmp_path: Path) -> None:
    places = [(100.0, 50.0), (120.0, 90.0), (60.0, 120.0), (200.0, 30.0)]
    spots = spots_in(tmp_path, [[led(*place)] for place in places], lights=[led(150.0, 140.0)])
    assert reasons(spots, (150.0, 140.0)) == {"it stands still"}
    assert spots.good.sum() == len(places)


def test_a_dark_picture_takes_away_what_shines_without_the_led(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    stage = Scenery.flat(SIZE, 25.0, (0.5, 0.0), lights=[led(60.0, 60.0, 1500.0), led(104.0, 80.0, 400.0)])
    for name, lights in (("on", [led(100.3, 80.7)]), ("off", [])):
        write_image(tmp_path / f"{name}.png", SENSOR.expose(stage.expected(lights), rng))
    spots = find_spots([ImageFile(tmp_path / "on.png", tmp_path / "off.png")], SIZE)
    assert spots.good.sum() == 1
    assert spots.fits.uv[spots.good][0] == pytest.approx([100.3, 80.7], abs=0.15)


def test_a_coloured_led_is_told_from_white_lights(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    layers = []
    for share in (1.0, 0.15, 0.1):
        stage = Scenery.flat(SIZE, 25.0, lights=[led(60.0, 60.0, 1200.0)])
        layers.append(SENSOR.expose(stage.expected([led(100.3, 80.7, 1000.0 * share)]), rng))
    write_image(tmp_path / "a.png", np.stack(layers, axis=-1))
    spots = find_spots([ImageFile(tmp_path / "a.png")], SIZE, "red")
    assert reasons(spots, (60.0, 60.0)) <= {"not red"}
    assert spots.good.sum() == 1
    assert spots.fits.uv[spots.good][0] == pytest.approx([100.3, 80.7], abs=0.1)


def test_an_image_of_another_size_is_refused(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.zeros((10, 12), np.uint8))
    with pytest.raises(CameraError, match=r"12 x 10 px, the camera 240 x 180"):
        find_spots([ImageFile(tmp_path / "a.png")], SIZE)
