from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.errors import CalibrationError
from urdfcal.estimation.alignment import kabsch, place_base


def random_pose(rng: np.random.Generator) -> np.ndarray:
    R = pin.exp3(rng.normal(0.0, 2.0, 3))
    return pin.SE3(R, rng.normal(0.0, 2.0, 3)).homogeneous


def test_kabsch_recovers_a_motion_and_never_a_reflection() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        T, points = random_pose(rng), rng.normal(size=(12, 3))
        np.testing.assert_allclose(kabsch(points, points @ T[:3, :3].T + T[:3, 3]), T, atol=1e-12)
        assert np.linalg.det(kabsch(points, -points)[:3, :3]) > 0.999


@pytest.mark.parametrize("leds", [1, 3])
def test_base_and_unknown_leds_are_found_from_anywhere(leds: int) -> None:
    rng = np.random.default_rng(leds)
    for _ in range(20):
        T_base_tip = np.array([random_pose(rng) for _ in range(20)])
        T_world_base, places = random_pose(rng), rng.normal(0.0, 0.1, (leds, 3))
        pose, led = np.repeat(np.arange(20), leds), np.tile(np.arange(leds), 20)
        in_base = (T_base_tip[pose] @ np.c_[places[led], np.ones(len(led))][..., None])[:, :3, 0]
        points = in_base @ T_world_base[:3, :3].T + T_world_base[:3, 3]
        T, found = place_base(
            T_base_tip[pose], led, points, np.zeros((leds, 3)), np.ones(leds, bool), np.zeros(leds, bool)
        )
        np.testing.assert_allclose(T, T_world_base, atol=1e-9)
        np.testing.assert_allclose(found, places, atol=1e-9)


def test_too_few_points_say_so() -> None:
    T, guess, flag = np.eye(4)[None].repeat(3, 0), np.zeros((1, 3)), np.ones(1, bool)
    with pytest.raises(CalibrationError, match="only 3 points"):
        place_base(T, np.zeros(3, int), np.eye(3), guess, flag, ~flag)
