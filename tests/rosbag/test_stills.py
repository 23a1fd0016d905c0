"""Where an arm stood still, told from its joint readings."""

from __future__ import annotations

import numpy as np
import pytest

from urdfcal.errors import SessionError
from urdfcal.rosbag.clock import Timeline, timeline
from urdfcal.rosbag.stills import find_stills

STEP = 20_000_000
PLACES = np.array([[0.0, 1.0], [0.5, 0.8], [-0.3, 0.2], [0.1, 0.1]])


def log(stops: list[float], noise: float = 0.0, drift: float = 0.0) -> np.ndarray:
    """Readings at 50 Hz of an arm that stops at each of some places, and takes half a second to the next."""
    rng, rows = np.random.default_rng(0), []
    for k, seconds in enumerate(stops):
        count = round(50 * seconds)
        rows.append(PLACES[k] + drift * 0.02 * np.arange(count)[:, None])
        if k + 1 < len(stops):
            u = np.linspace(0.0, 1.0, 26)[1:-1, None]
            rows.append(rows[-1][-1] + (PLACES[k + 1] - rows[-1][-1]) * u * u * (3.0 - 2.0 * u))
    readings = np.concatenate(rows)
    return readings + rng.normal(0.0, noise, readings.shape) if noise else readings


def times(readings: np.ndarray, topic: str = "/joint_states") -> Timeline:
    stamps = [10**18 + STEP * i for i in range(len(readings))]
    return timeline(topic, stamps, stamps)


@pytest.mark.parametrize("noise", [0.0, 2e-5, 1e-4])
def test_every_stop_is_a_pose_and_its_readings_are_known_to_what_is_said(noise: float) -> None:
    readings = log([2.0, 2.0, 2.0, 2.0], noise)
    still = find_stills(times(readings), readings)
    assert len(still) == 4
    error = still.readings - PLACES
    assert np.abs(error).max() < 4.0 * max(still.sigma, 1e-12)
    assert still.sigma == pytest.approx(noise / np.sqrt(85.0), rel=0.6, abs=1e-7)
    assert ((still.end - still.start) > 1.5e9).all()
    assert still.creeping == 0


def test_a_servo_of_coarse_steps_flickers_and_is_known_to_a_step() -> None:
    step = 2.0 * np.pi / 4096
    readings = np.round((log([2.0, 2.0, 2.0, 2.0], 2e-4) + 1e-4) / step) * step
    still = find_stills(times(readings), readings)
    assert len(still) == 4
    assert still.sigma == pytest.approx(step / np.sqrt(12.0), rel=0.2)


def test_stops_at_corners_and_creeping_are_no_poses() -> None:
    readings = log([2.0, 0.6, 2.0, 2.0])
    assert len(find_stills(times(readings), readings)) == 3
    readings = log([2.0, 2.0, 2.0, 2.0])
    readings[-100:] += 2.5e-3 * 0.02 * np.arange(100)[:, None]
    still = find_stills(times(readings), readings)
    assert (len(still), still.creeping) == (3, 1)


def test_an_arm_that_hardly_stops_is_said_to() -> None:
    readings = log([2.0, 0.5, 0.5, 2.0])
    with pytest.raises(SessionError, match=r"2 times: these are too few poses.*--stills"):
        find_stills(times(readings), readings)


def test_of_images_the_one_in_the_middle_is_taken() -> None:
    readings = log([2.0, 2.0, 2.0, 2.0])
    still = find_stills(times(readings), readings)
    # A camera at 5 Hz, that was switched on during the second stop.
    stamps = [10**18 + 3_300_000_000 + 200_000_000 * i for i in range(32)]
    chosen = still.nearest(timeline("/image", stamps, stamps))
    assert sorted(chosen) == [1, 2, 3]
    for k, number in chosen.items():
        assert still.start[k] <= stamps[number - 1] <= still.end[k]
    assert abs(stamps[chosen[2] - 1] - (still.start[2] + still.end[2]) / 2) <= 1e8
