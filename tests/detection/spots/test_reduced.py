"""Large spots: measured at a fraction of the resolution, in pixels of the full one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.detection.spots.detector import Spots, fall_off, find_spots
from urdfcal.detection.spots.reduced import clipped, reduced
from urdfcal.images.files import ImageFile, write_image
from urdfcal.simulation.render import Light, Scenery, Sensor

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

# No multiple of the factors: what is cut off moves nothing.
SIZE = (323, 247)
SENSOR = Sensor(SIZE, 8, 8.0)
AT = np.array([[150.3, 120.7], [170.1, 110.2], [140.8, 135.5], [160.0, 128.4]])


def light(place: Sequence[float], sigma: float, peak: float = 1000.0) -> Light:
    return Light(np.array(place), peak, sigma)


def spots_in(folder: Path, exposures: Sequence[Sequence[Light]], *, dark: bool = False, colour: str = "any") -> Spots:
    rng, images = np.random.default_rng(0), []
    stage = Scenery.flat(SIZE, 25.0)
    for k, lights in enumerate(exposures):
        off = folder / f"{k}.off.png" if dark else None
        images.append(ImageFile(folder / f"{k}.png", off))
        for path, on in ((images[-1].path, lights), (off, [])):
            if path is None:
                continue
            image = SENSOR.expose(stage.expected(on), rng)
            grey = SENSOR.expose(stage.expected([]), rng)
            write_image(path, image if colour == "any" else np.stack([image, grey, grey], axis=-1))
    return find_spots(images, SIZE, colour)


@pytest.mark.parametrize(
    ("sigma", "options"), [(6.5, {}), (9.0, {}), (14.0, {}), (9.0, {"dark": True}), (9.0, {"colour": "red"})]
)
def test_a_large_spot_is_found_where_it_is_to_what_is_claimed(tmp_path: Path, sigma: float, options: dict) -> None:
    spots = spots_in(tmp_path, [[light(place, sigma)] for place in AT], **options)
    seen = spots[spots.good]
    assert seen.image.tolist() == [0, 1, 2, 3]
    assert (np.linalg.norm(seen.fits.uv - AT, axis=1) < 5.0 * seen.fits.sigma).all()
    assert (seen.fits.sigma < 0.06).all()
    assert seen.fits.width == pytest.approx(sigma, rel=0.03)
    assert "larger than an LED" not in spots.reasons


def test_a_large_spot_that_is_saturated_is_found(tmp_path: Path) -> None:
    seen = spots_in(tmp_path, [[light(place, 9.0, 4000.0)] for place in AT])
    seen = seen[seen.good]
    assert np.abs(seen.fits.uv - AT).max() < 0.1
    assert (seen.fits.saturated > 300).all()


def test_where_small_leds_are_found_large_lights_are_still_none(tmp_path: Path) -> None:
    spots = spots_in(tmp_path, [[light(place, 1.5), light(place - [90.0, 60.0], 9.0)] for place in AT])
    assert spots.image[spots.good].tolist() == [0, 1, 2, 3]
    assert (spots.fits.width[spots.good] < 2.0).all()
    assert "larger than an LED" in spots.reasons


def test_beside_a_small_led_a_large_light_is_none_though_other_images_have_nothing_else(tmp_path: Path) -> None:
    large = [[light(place, 9.0)] for place in AT]
    spots = spots_in(tmp_path, [*large, [light((60.0, 60.0), 1.5), light((220.0, 100.0), 9.0)]])
    assert spots.image[spots.good].tolist() == [0, 1, 2, 3, 4]
    assert spots.fits.uv[spots.good][4] == pytest.approx([60.0, 60.0], abs=0.1)


def test_what_is_small_and_no_spot_is_none_at_less_resolution_either(tmp_path: Path) -> None:
    """A ring, which four times smaller looks round."""
    angle = np.arange(8) * np.pi / 4.0
    circle = 4.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    rings = [[light(place - [90.0, 60.0] + c, 0.8, 500.0) for c in circle] for place in AT]
    spots = spots_in(tmp_path, [[*ring, light(place, 20.0)] for ring, place in zip(rings, AT, strict=True)])
    seen = spots[spots.good]
    assert seen.image.tolist() == [0, 1, 2, 3]
    assert (seen.fits.width > 15.0).all()


@pytest.mark.parametrize(("without", "count"), [(2, 4), (3, 13)])
def test_a_few_images_of_a_lamp_alone_do_not_make_it_an_led(tmp_path: Path, without: int, count: int) -> None:
    """Two at all are too few, and so is less than a quarter."""
    lamps = [[light(place, 9.0)] for place in AT[:without]]
    leds = [[light(place, 1.5)] for place in np.random.default_rng(3).uniform(40.0, 200.0, (count - without, 2))]
    spots = spots_in(tmp_path, lamps + leds)
    assert not (spots.image[spots.good] < without).any()
    assert "larger than an LED" in spots.reasons[spots.image < without]


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(9, 15), (9, 15, 3)])
def test_reducing_takes_means_and_tells_what_may_be_clipped(depth: type, shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(10, 200, shape).astype(depth)
    image[2, 5] = np.iinfo(depth).max
    small, full = reduced(image, 4), clipped(image, 4)
    assert small.shape == full.shape == (2, 3, *shape[2:])
    assert full[0, 1].all()
    assert np.count_nonzero(full) == full[0, 1].size
    means = image[:8, :12].reshape(2, 4, 3, 4, *shape[2:]).mean(axis=(1, 3))
    np.testing.assert_allclose(small, (16.0 if depth == np.uint8 else 1.0) * means, atol=0.5)
    assert reduced(image, 1) is image
    assert np.count_nonzero(clipped(image, 1)) == full[0, 1].size


def filmed(folder: Path, sigma: float, peak: float, vignetting: float) -> tuple[np.ndarray, Spots]:
    """Thirty images of one light at places all over the image, and what was found."""
    sensor, rng, images = Sensor((480, 360), 8, 10.0), np.random.default_rng(5), []
    stage = Scenery.flat(sensor.resolution, 25.0, (0.005, -0.005), vignetting)
    places = rng.uniform([4.0 * sigma] * 2, np.array(sensor.resolution) - 4.0 * sigma, (30, 2))
    for k, place in enumerate(places):
        images.append(ImageFile(folder / f"{k:02}.png"))
        write_image(images[-1].path, sensor.expose(stage.expected([light(place, sigma, peak)]), rng))
    seen = find_spots(images, sensor.resolution)
    return places, seen[seen.good]


@pytest.mark.no_cover
@pytest.mark.parametrize(("sigma", "peak"), [(6.5, 4000.0), (14.0, 10000.0), (22.0, 1500.0)])
def test_large_spots_are_measured_to_what_is_claimed(tmp_path: Path, sigma: float, peak: float) -> None:
    """Saturated or not, and though in a third of the images they lie over the same place."""
    places, seen = filmed(tmp_path, sigma, peak, 0.0)
    assert seen.image.tolist() == list(range(30))
    error = seen.fits.uv - places
    assert np.sqrt(np.mean(error**2)) < 0.02
    own = np.sqrt(seen.fits.sigma**2 - fall_off(seen.fits, (480, 360)) ** 2)
    assert 0.75 < np.sqrt(np.mean((error / own[:, None]) ** 2)) < 1.25


@pytest.mark.no_cover
@pytest.mark.parametrize("sigma", [5.5, 14.0])
def test_that_a_lens_darkens_towards_the_corners_is_in_what_is_claimed(tmp_path: Path, sigma: float) -> None:
    places, seen = filmed(tmp_path, sigma, 1500.0, 0.35)
    assert len(seen) == 30
    error = seen.fits.uv - places
    assert 0.7 < np.sqrt(np.mean((error / seen.fits.sigma[:, None]) ** 2)) < 1.3
