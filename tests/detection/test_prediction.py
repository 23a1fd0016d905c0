"""Where a camera should see the LED: when images are enough to say it, and when they are not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from urdfcal.detection.prediction import Lights, Prediction, predict
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.kinematics import tip_poses
from urdfcal.session.knowledge import Led
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from urdfcal.cameras.camera import Camera


@dataclass(frozen=True)
class Images:
    """What the first camera of a simulated session saw of its LED."""

    camera: Camera
    led: Led
    T_base_tip: np.ndarray
    uv: np.ndarray

    def predict(
        self, count: int, led: Led | None = None, strangers: int = 0, displaced: float = 0.0
    ) -> tuple[Prediction | None, Lights]:
        """Predict from the first images; in some of them, a brighter light is elsewhere."""
        uv = self.uv[:count] + np.random.default_rng(1).normal(0.0, displaced, (count, 2))
        away = np.random.default_rng(0).uniform([0.0, 0.0], self.camera.resolution, (strangers, 2))
        lights = Lights(
            np.concatenate([np.arange(count), np.arange(strangers)]),
            np.concatenate([uv, away]),
            np.concatenate([np.full(count, 10.0), np.full(strangers, 20.0)]),
        )
        leds = (led or self.led,)
        return predict(self.camera, leds, self.T_base_tip[:count], np.zeros(count, np.intp), lights), lights


@pytest.fixture(scope="module")
def images() -> Images:
    session = simulate(read_rig(find_rig("ur5")), poses=20, seed=3).session
    seen = session.find(Detections)
    mine = seen.camera == 0
    T = tip_poses(session.chain, session.q)[seen.pose[mine]]
    return Images(session.rig.cameras[0], session.leds[0], T, seen.uv[mine])


@pytest.mark.parametrize("count", [1, 2, 5])
def test_five_pictures_are_too_few(images: Images, count: int) -> None:
    assert images.predict(count)[0] is None


def test_six_pictures_are_enough(images: Images) -> None:
    prediction, lights = images.predict(6)
    assert prediction is not None
    assert prediction.near(lights).all()


def test_pictures_through_no_lens_do_not_count(images: Images) -> None:
    """A light where the lens model has no ray is none of the six."""
    bent = replace(images.camera, distortion_model="radtan", distortion=np.array([-0.6, 0.0, 0.0, 0.0]))
    uv = images.uv[:6].copy()
    uv[0] = [-3000.0, -3000.0]
    lights = Lights(np.arange(6), uv, np.ones(6))
    assert predict(bent, (images.led,), images.T_base_tip[:6], np.zeros(6, np.intp), lights) is None


@pytest.mark.parametrize("strangers", [8, 14, 20])
def test_brighter_lights_in_every_picture_do_not_hide_the_arms(images: Images, strangers: int) -> None:
    prediction, lights = images.predict(20, strangers=strangers)
    assert prediction is not None
    near = prediction.near(lights)
    assert near[:20].all()
    assert (~near[20:]).sum() >= strangers - 1


def among_brighter_ones(images: Images, *uv: np.ndarray) -> Prediction | None:
    """Predict from lights (20, 2) each, and a brighter one elsewhere in every image."""
    away = np.random.default_rng(0).uniform([0.0, 0.0], images.camera.resolution, (20, 2))
    lights = Lights(
        np.tile(np.arange(20), len(uv) + 1), np.concatenate([*uv, away]), np.repeat([10.0] * len(uv) + [20.0], 20)
    )
    return predict(images.camera, (images.led,), images.T_base_tip, np.zeros(20, np.intp), lights)


def test_lights_outshone_must_be_the_arms_in_most_pictures(images: Images) -> None:
    few = images.uv.copy()
    few[:12] = np.random.default_rng(1).uniform([0.0, 0.0], images.camera.resolution, (12, 2))
    assert among_brighter_ones(images, few) is None


def test_two_lights_that_move_as_the_arm_does_are_not_told_apart(images: Images) -> None:
    turned = images.camera.unproject(images.uv) @ rotation_y(0.1).T
    assert among_brighter_ones(images, images.uv) is not None
    assert among_brighter_ones(images, images.uv, images.camera.project(turned)) is None


def rotation_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def test_an_led_may_be_off_as_far_as_its_sigma_says(images: Images) -> None:
    """Without one as far as a ruler errs: what is farther off is not this arm's LED."""
    far = images.led.position + np.array([0.0, 0.25, 0.25])
    assert images.predict(20, Led("led", far))[0] is None
    assert images.predict(20, Led("led", far, 0.01))[0] is None
    prediction, lights = images.predict(20, Led("led", far, 0.3))
    assert prediction is not None
    assert prediction.near(lights).mean() > 0.9


def test_an_led_given_to_a_ruler_is_found(images: Images) -> None:
    prediction, lights = images.predict(20, Led("led", images.led.position))
    assert prediction is not None
    assert prediction.near(lights).all()


def test_the_gate_follows_the_pictures(images: Images) -> None:
    close, far = (images.predict(20, displaced=spread)[0] for spread in (0.5, 8.0))
    assert close is not None
    assert far is not None
    assert 3.0 < np.median(close.gate) < 20.0 < np.median(far.gate)


def test_the_gate_is_wider_for_an_led_nearer_to_the_camera(images: Images) -> None:
    prediction, _ = images.predict(20, displaced=4.0)
    assert prediction is not None
    rays = np.ascontiguousarray(images.camera.unproject(images.uv)[:, :2])
    T = images.T_base_tip
    points = T[:, :3, 3] + T[:, :3, :3] @ images.led.position
    _, rotation, translation = cv2.solvePnP(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    distance = np.linalg.norm(points @ cv2.Rodrigues(rotation)[0].T + translation.ravel(), axis=1)
    # Apart from the allowance, it goes with one over the distance.
    share = (prediction.gate - 3.0) * distance
    assert np.ptp(distance) > 0.2 * distance.mean()
    assert np.ptp(share) < 0.05 * share.mean()


def test_out_of_sight_nothing_is_near(images: Images) -> None:
    prediction, _ = images.predict(20)
    assert prediction is not None
    hidden = replace(prediction, uv=np.full_like(prediction.uv, np.nan))
    assert np.isinf(hidden.misses(Lights(np.arange(20), images.uv, np.ones(20)))).all()
