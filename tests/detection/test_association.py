"""Which lights of several cameras are one LED: by rays, and by brightness where rays do not decide."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.io.making import looking
from urdfcal.cameras.camera import Camera
from urdfcal.cameras.rig import Rig
from urdfcal.detection.association import LightCandidate as Light
from urdfcal.detection.association import associate

if TYPE_CHECKING:
    from collections.abc import Sequence

TARGET = np.array([0.6, 0.0, 0.5])
ASIDE = np.array([0.0, 0.02, 0.05])  # m
AWAY = np.array([30.0, 40.0])  # px
# Of two cameras' four residuals one is not explained by a point, and each camera takes half of it.
UP = np.array([0.0, np.sqrt(2.0)])
PLACES = ([2.4, 0.5, 0.9], [2.4, -0.5, 0.9], [2.2, 0.0, 1.8])
CAMERAS = [Camera(name, (1280, 1024), np.array([1400.0, 1400.0, 640.0, 512.0])) for name in ("a", "b", "c")]
T_CAM_BASE = [looking(place, TARGET.tolist()) for place in PLACES]


def rig_of(count: int, unknown: Sequence[int] = ()) -> Rig:
    """The first cameras, the first of which is the world, some of them of unknown pose."""
    world = np.linalg.inv(T_CAM_BASE[0])
    known = [np.eye(4), *(T @ world for T in T_CAM_BASE[1:count])]
    return Rig(CAMERAS[:count], tuple(None if c in unknown else T for c, T in enumerate(known)))


def seen(camera: int, point: np.ndarray) -> np.ndarray:
    """Where a camera sees a point of the base frame. [px]"""
    return CAMERAS[camera].project((T_CAM_BASE[camera] @ [*point, 1.0])[:3])


class Lights:
    """Lights of one LED at one pose, their rows counted on in each camera."""

    def __init__(self) -> None:
        self._rows = [0, 0, 0]

    def __call__(self, camera: int, uv: np.ndarray, flux: float = 10.0) -> Light:
        self._rows[camera] += 1
        return Light(camera, self._rows[camera] - 1, uv, flux)

    def point(self, point: np.ndarray, cameras: Sequence[int], flux: float = 10.0) -> list[Light]:
        return [self(c, seen(c, point), flux) for c in cameras]


@pytest.fixture
def light() -> Lights:
    return Lights()


def honest(light: Lights, cameras: Sequence[int], noise: float = 0.1, count: int = 12) -> list[list[Light]]:
    """Poses at which each camera sees one light."""
    rng = np.random.default_rng(0)
    groups = []
    for _ in range(count):
        point = TARGET + rng.uniform(-0.2, 0.2, 3)
        groups.append([light(c, seen(c, point) + noise * rng.standard_normal(2)) for c in cameras])
    return groups


def rejected(rig: Rig, groups: list[list[Light]]) -> dict[tuple[int, int], str]:
    verdict, warnings = associate(rig, groups)
    assert not warnings
    return verdict


def keys(lights: Sequence[Light]) -> set[tuple[int, int]]:
    return {(light.camera, light.row) for light in lights}


def test_a_third_camera_that_sees_only_something_else_is_left_out(light: Lights) -> None:
    groups = honest(light, (0, 1, 2))
    wrong = light(2, seen(2, TARGET) + AWAY, 50.0)
    groups.append([*light.point(TARGET, (0, 1)), wrong])
    verdict = rejected(rig_of(3), groups)
    assert set(verdict) == keys([wrong])
    assert "does not meet" in verdict[2, wrong.row]


def test_most_cameras_win_over_brightness(light: Lights) -> None:
    """A bright pair of two cameras is no match for a dim light that all three see."""
    groups = honest(light, (0, 1, 2))
    dim, bright = TARGET + ASIDE, TARGET - ASIDE
    pair = light.point(bright, (0, 1), 100.0)
    groups.append([*light.point(dim, (0, 1, 2), 5.0), *pair])
    assert set(rejected(rig_of(3), groups)) == keys(pair)


@pytest.mark.parametrize(("brighter", "kept"), [(1.5, False), (2.5, True)])
def test_of_two_lights_whose_rays_meet_only_a_much_brighter_one_is_the_led(
    light: Lights, brighter: float, kept: bool
) -> None:
    groups = honest(light, (0, 1))
    bright = light.point(TARGET, (0, 1), 10.0 * brighter)
    dim = light.point(TARGET + ASIDE, (0, 1))
    groups.append([*dim, *bright])
    verdict = rejected(rig_of(2), groups)
    assert set(verdict) == (keys(dim) if kept else keys([*dim, *bright]))
    words = "weaker than another light whose rays meet" if kept else "as bright, and the rays of both meet"
    assert all(words in reason for reason in verdict.values())


@pytest.mark.parametrize(("noise", "miss", "kept"), [(0.05, 0.6, True), (0.05, 2.0, False), (0.7, 2.0, True)])
def test_the_gate_follows_how_well_rays_usually_meet(light: Lights, noise: float, miss: float, kept: bool) -> None:
    groups = honest(light, (0, 1), noise, 40)
    a, b = light.point(TARGET, (0, 1))
    off = light(1, b.uv + miss * UP)
    groups.append([a, off])
    verdict = rejected(rig_of(2), groups)
    assert set(verdict) == (set() if kept else keys([a, off]))
    assert all("miss each other by" in reason for reason in verdict.values())


def test_poses_with_several_lights_do_not_say_how_well_rays_meet(light: Lights) -> None:
    """Most poses have a stranger in each camera, listed first: their rays miss by tens of pixels."""
    groups = honest(light, (0, 1), count=4)
    strangers = []
    for group in honest(light, (0, 1), count=10):
        pair = [light(0, group[0].uv + AWAY), light(1, group[1].uv - AWAY)]
        groups.append([*pair, *group])
        strangers += pair
    assert set(rejected(rig_of(2), groups)) == keys(strangers)


def test_rays_that_run_apart_are_said_not_to_meet_at_all(light: Lights) -> None:
    groups = honest(light, (0, 1))
    apart = [light(0, np.array([1270.0, 500.0])), light(1, np.array([5.0, 500.0]))]
    groups.append(apart)
    verdict = rejected(rig_of(2), groups)
    assert set(verdict) == keys(apart)
    assert {reason for reason in verdict.values() if "px" not in reason} == set(verdict.values())


def test_a_camera_of_unknown_pose_is_decided_by_brightness_alone(light: Lights) -> None:
    groups = honest(light, (0, 1))
    elsewhere = [light(2, np.array([100.0, 100.0]), 30.0), light(2, np.array([900.0, 100.0]))]
    groups.append([*light.point(TARGET, (0, 1)), *elsewhere])
    verdict = rejected(rig_of(3, unknown=[2]), groups)
    assert set(verdict) == keys(elsewhere[1:])
    assert "weaker than another light" in verdict[2, elsewhere[1].row]


def test_without_two_cameras_of_known_pose_brightness_decides(light: Lights) -> None:
    pair = [light(0, np.array([600.0, 500.0]), 30.0), light(0, np.array([700.0, 500.0]))]
    groups = [*honest(light, (0, 1)), [*pair, light(1, np.array([3.0, 3.0]))]]
    assert set(rejected(rig_of(2, unknown=[1]), groups)) == keys(pair[1:])


def test_cameras_that_miss_by_five_pixels_are_not_where_the_file_says(light: Lights) -> None:
    def warned(miss: float) -> list[str]:
        groups = honest(light, (0, 1), 0.0)
        shifted = [[a, light(1, b.uv + miss * UP)] for a, b in groups]
        verdict, warnings = associate(rig_of(2), shifted)
        assert not verdict
        return warnings

    assert warned(4.0) == []
    (warning,) = warned(6.0)
    assert "rays miss each other by" in warning
