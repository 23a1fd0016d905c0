"""Which lights are the LED's by where the arm holds it: between moves, and beside the arm itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.detection.association import LightCandidate, associate
from urdfcal.detection.held import Shown
from urdfcal.detection.led_frames import LedFrames
from urdfcal.detection.spots.again import Expected, look_again
from urdfcal.detection.spots.centroid import Fits
from urdfcal.detection.spots.detector import Spots, find_spots
from urdfcal.estimation.measurements import Detections
from urdfcal.images.files import ImageFile, Video, write_image
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.kinematics import tip_poses
from urdfcal.simulation.render import Light, Scenery, Sensor
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from urdfcal.session.model import Session

UPSIDE_DOWN = [-1.0, -1.0, 1.0]
SIZE = 140


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(read_rig(find_rig("ur5")), poses=24, seed=3).session


def spots_at(uv: np.ndarray) -> Spots:
    numbers = {name: np.ones(len(uv)) for name in ("sigma", "peak", "width", "ratio", "significance")}
    none = np.zeros(len(uv))
    fits = Fits(uv, **numbers, misfit=none, lobe=none, saturated=none.astype(int), found=np.ones(len(uv), bool))
    return Spots.of(np.arange(len(uv)), fits)


def test_the_arm_holds_the_led_elsewhere_after_a_move(session: Session) -> None:
    camera, seen = session.rig.cameras[0], session.find(Detections)
    mine = seen.camera == 0
    uv, count = seen.uv[mine].copy(), int(mine.sum())
    after = np.arange(count) >= 15
    uv[after] = camera.project(camera.unproject(uv[after]) * UPSIDE_DOWN)
    frames = LedFrames(
        session.leds,
        np.zeros(count, np.intp),
        tip_poses(session.chain, session.q)[seen.pose[mine]],
        np.ones(count, dtype=bool),
    )
    shown = Shown(camera, Video(Path("no.mp4"), (), 0), frames, after.astype(np.intp), "any")
    judged, warnings = shown.held(spots_at(uv))
    assert judged.good.all()
    assert not warnings
    unsaid, _ = replace(shown, stretch=np.zeros(count, np.intp)).held(spots_at(uv))
    assert not unsaid.good[after].any()


def test_rays_of_a_camera_that_was_moved_decide_nothing(session: Session) -> None:
    seen = session.find(Detections)
    away = np.where(seen.camera == 1, 60.0, 0.0)[:, None]
    groups: dict[int, list[LightCandidate]] = {}
    for row, (pose, camera, uv) in enumerate(zip(seen.pose, seen.camera, seen.uv + away, strict=True)):
        groups.setdefault(int(pose), []).append(LightCandidate(int(camera), row, uv, 10.0))
    assert associate(session.rig, list(groups.values()), (1,)) == ({}, [])


def test_an_led_beside_a_bright_arm_is_found_by_a_second_look(tmp_path: Path) -> None:
    places = np.stack([np.arange(25.3, 115.0, 10.1), 70.6 + 20.0 * np.sin(np.arange(9))], axis=1)
    sensor, scenery = Sensor((SIZE, SIZE), 8, 10.0), Scenery.flat((SIZE, SIZE), 60.0)
    for k, place in enumerate(places):
        electrons = scenery.expected([Light(place, 1000.0, 1.5)])
        edge = round(place[0]) + 9 + k % 3
        electrons[:, edge : edge + 40] += 1500.0
        write_image(tmp_path / f"{k}.png", sensor.expose(electrons, np.random.default_rng(k)))
    files, each = [ImageFile(tmp_path / f"{k}.png") for k in range(9)], np.arange(9)
    first = find_spots(files, (SIZE, SIZE))
    assert first.good.sum() < 5
    flux = 2.0 * np.pi * 100.0 * (1.5**2 + 1.0 / 12.0)
    expected = Expected(each, places + np.array([5.0, -4.0]), np.full(9, 10.0), 1.5, flux)
    again = look_again(files, (SIZE, SIZE), "any", each, expected)
    assert again.image.tolist() == each.tolist()
    assert np.linalg.norm(again.fits.uv - places, axis=1).max() < 0.1
    for other in (replace(expected, width=3.0), replace(expected, flux=6.0 * flux)):
        assert not len(look_again(files, (SIZE, SIZE), "any", each, other))
