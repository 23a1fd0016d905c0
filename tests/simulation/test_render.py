"""The image formation model."""

from __future__ import annotations

import numpy as np
import pytest

from tests.centroid_bound import centroid_bound, variance
from urdfcal.errors import CameraError
from urdfcal.simulation.render import Light, Scenery, Sensor, add_light

SIZE = (64, 48)


def drawn(light: Light) -> np.ndarray:
    electrons = np.zeros(SIZE[::-1])
    add_light(electrons, light)
    return electrons


def moments(electrons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.indices(electrons.shape)
    weight = electrons / electrons.sum()
    mean = np.array([np.sum(weight * u), np.sum(weight * v)])
    return mean, np.array([np.sum(weight * (u - mean[0]) ** 2), np.sum(weight * (v - mean[1]) ** 2)])


@pytest.mark.parametrize("sigma", [0.5, 1.0, 3.0])
def test_a_spot_holds_its_light_its_place_and_its_width_with_the_pixels_own(sigma: float) -> None:
    electrons = drawn(Light(np.array([31.3, 22.8]), 500.0, sigma))
    mean, variance = moments(electrons)
    assert electrons.sum() == pytest.approx(2.0 * np.pi * sigma**2 * 500.0, rel=1e-7)
    # Below half a pixel, sampling by pixels moves the mean itself.
    assert mean == pytest.approx([31.3, 22.8], abs=1e-6 if sigma > 0.5 else 3e-3)
    assert variance == pytest.approx(sigma**2 + 1.0 / 12.0, rel=1e-5 if sigma > 0.5 else 0.1)


def test_a_streak_has_the_same_light_and_is_longer_by_its_motion() -> None:
    still, moving = (drawn(Light(np.array([30.0, 24.0]), 500.0, 1.5, motion)) for motion in ([0.0, 0.0], [9.0, 0.0]))
    mean, variance = moments(moving)
    assert moving.sum() == pytest.approx(still.sum(), rel=1e-7)
    assert mean == pytest.approx([30.0, 24.0], abs=1e-6)
    assert variance[0] - moments(still)[1][0] == pytest.approx(81.0 / 12.0, rel=0.02)


def test_a_light_cut_by_the_border_or_outside_leaves_the_rest_dark() -> None:
    assert drawn(Light(np.array([-0.5, 20.0]), 100.0, 2.0)).sum() == pytest.approx(np.pi * 4.0 * 100.0, rel=1e-6)
    assert not drawn(Light(np.array([-200.0, 20.0]), 100.0, 2.0)).any()


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_noise_is_that_of_the_sensor(bits: int) -> None:
    sensor = Sensor(SIZE, bits, electrons_per_count=40.0 / 2 ** (bits - 8), read_noise=5.0, black=10.0)
    electrons = np.full((200, 200), 900.0)
    counts = sensor.expose(electrons, np.random.default_rng(0))
    assert counts.dtype == (np.uint8 if bits == 8 else np.uint16)
    read = (counts - sensor.black) * sensor.electrons_per_count
    assert read.mean() == pytest.approx(900.0, rel=0.01)
    assert read.var() == pytest.approx(float(variance(sensor, np.array(900.0))), rel=0.04)


def test_a_sensor_saturates_at_its_full_well() -> None:
    sensor = Sensor(SIZE, 8, 10.0)
    counts = sensor.expose(np.array([0.5, 1.5]) * sensor.full_well, np.random.default_rng(0))
    assert counts[0] < sensor.white == counts[1]


def test_vignetting_darkens_corners_and_hot_pixels_shine_by_themselves() -> None:
    hot = np.array([[5, 7]])
    scenery = Scenery.flat(SIZE, 100.0, vignetting=0.4, hot=hot, leak=np.array([1000.0]))
    electrons = scenery.expected([])
    assert electrons[0, 0] == pytest.approx(60.0, rel=0.05)
    assert electrons[24, 32] == pytest.approx(100.0, rel=0.01)
    assert electrons[7, 5] == pytest.approx(scenery.background[7, 5] + 1000.0)


def test_the_bound_is_the_textbook_one_for_a_bright_spot_without_background() -> None:
    # Shot noise alone: sigma / sqrt(photons), a little more for the pixel's width.
    sensor = Sensor(SIZE, 16, 0.01, read_noise=0.1, black=0.0)
    photons = 2.0 * np.pi * 2.0**2 * 500.0
    bound = centroid_bound(Sensor(SIZE, 16, 0.02, 0.1, 0.0), Light(np.zeros(2), 500.0, 2.0), 0.0)
    assert bound == pytest.approx(np.sqrt(2.0**2 + 1.0 / 12.0) / np.sqrt(photons), rel=0.03)
    assert centroid_bound(sensor, Light(np.zeros(2), 500.0, 2.0), 100.0) > bound


def test_impossible_sensors_are_refused() -> None:
    with pytest.raises(CameraError):
        Sensor(SIZE, bits=17)
    with pytest.raises(CameraError):
        Sensor(SIZE, electrons_per_count=0.0)
