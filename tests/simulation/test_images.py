"""The images behind a simulated session: lights where the truth says, and what is written beside them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from urdfcal.cameras.rig import Rig
from urdfcal.detection.detect import detect
from urdfcal.errors import OutputError, SessionError
from urdfcal.images.files import read_image
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.session.knowledge import Led
from urdfcal.simulation.images import TRUTH, Exposure, write_simulated_images
from urdfcal.simulation.motion import MotionSettings, set_in_motion
from urdfcal.simulation.moving import pixels_by_row
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.session.rig_description import RigDescription
    from urdfcal.simulation.truth import Simulated


@pytest.fixture(scope="module")
def small() -> RigDescription:
    """A rig at a quarter of its resolution: a sixteenth of the time."""
    rig = read_rig(find_rig("elbow3r"))
    cameras = [replace(one, resolution=(320, 256), intrinsics=one.intrinsics / 4.0) for one in rig.rig.cameras]
    return replace(rig, rig=Rig(tuple(cameras), rig.rig.T_cam_world))


@pytest.fixture(scope="module")
def still(small: RigDescription) -> Simulated:
    return simulate(small, poses=4, seed=3)


def truth_of(folder: Path) -> dict[tuple[str, str, str], np.ndarray]:
    with (folder / TRUTH).open(newline="") as file:
        return {(r["pose"], r["camera"], r["led"]): np.array([r["u"], r["v"]], float) for r in csv.DictReader(file)}


def test_every_led_is_in_its_image_where_the_truth_says(still: Simulated, tmp_path: Path) -> None:
    counts: list[int] = []
    assert write_simulated_images(tmp_path / "s", still, Exposure(), counts.append) == sum(counts) == 8
    session, truth = still.session, truth_of(tmp_path / "s")
    uv = still.truth.pixels(still.truth.q)
    assert len(truth) == len(list((tmp_path / "s" / "images").rglob("*.png"))) == 8
    for p, pose in enumerate(session.poses):
        for c, camera in enumerate(session.rig.names):
            np.testing.assert_array_equal(truth[pose, camera, "led"], uv[p, c, 0])
            image = read_image(tmp_path / "s" / "images" / camera / f"{pose}.png").astype(float)
            v, u = np.unravel_index(np.argmax(image), image.shape)
            assert np.hypot(u - uv[p, c, 0, 0], v - uv[p, c, 0, 1]) < 2.0
    assert not (tmp_path / "s" / "detections.csv").exists()
    assert json.loads((tmp_path / "s" / "truth.json").read_text())["poses"] == 4


def test_the_same_seed_gives_the_same_images(still: Simulated, tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_simulated_images(tmp_path / name, still, Exposure(distractors=True))
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file()]
    assert len(files) > 8
    assert all((tmp_path / "a" / one).read_bytes() == (tmp_path / "b" / one).read_bytes() for one in files)


def test_with_distractors_some_leds_are_not_to_be_found(small: RigDescription, tmp_path: Path) -> None:
    simulated = simulate(small, poses=40, seed=1)
    count = write_simulated_images(tmp_path / "s", simulated, Exposure(distractors=True))
    # A tenth of the LEDs is hidden or moves, by the shares drawn; lamps that outshine the sensor add to that.
    assert 0.7 * count < len(truth_of(tmp_path / "s")) < count


def test_an_led_before_a_lamp_that_saturates_the_sensor_is_not_to_be_found(still: Simulated, tmp_path: Path) -> None:
    # To a sensor that saturates at next to nothing the wall is such a lamp.
    write_simulated_images(tmp_path / "s", still, Exposure(electrons_per_count=1e-3))
    assert truth_of(tmp_path / "s") == {}


def test_of_several_leds_one_is_lit_at_a_time(small: RigDescription, tmp_path: Path) -> None:
    leds = (*small.leds, Led("second", np.array([0.0, -0.05, -0.06])))
    simulated = simulate(replace(small, leds=leds), poses=3, seed=3)
    assert write_simulated_images(tmp_path / "s", simulated, Exposure()) == 12
    names = {path.name for path in (tmp_path / "s" / "images" / "cam0").iterdir()}
    assert names == {f"{pose}.{led}.png" for pose in simulated.session.poses for led in ("led", "second")}


def test_a_moving_arm_is_filmed_frame_by_frame_or_as_videos(still: Simulated, tmp_path: Path) -> None:
    moving = set_in_motion(still, MotionSettings(speed=2.0, frame_rate=2.0))
    count = len(moving.session.poses)
    counts: list[int] = []
    assert write_simulated_images(tmp_path / "a", moving, Exposure()) == count
    assert write_simulated_images(tmp_path / "b", moving, Exposure(), counts.append, video_rate=2.0) == count
    assert sum(counts) == count
    videos = {
        path.stem: cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)
        for path in (tmp_path / "b" / "images").iterdir()
    }
    assert videos == {camera.name: len(list((tmp_path / "a" / "images" / camera.name).iterdir()))
                      for camera in moving.session.rig.cameras}  # fmt: skip
    assert (tmp_path / "a" / TRUTH).read_bytes() == (tmp_path / "b" / TRUTH).read_bytes()


def test_only_a_moving_arm_with_one_led_makes_a_video(small: RigDescription, still: Simulated, tmp_path: Path) -> None:
    leds = (*small.leds, Led("second", np.array([0.0, -0.05, -0.06])))
    two = set_in_motion(simulate(replace(small, leds=leds), poses=3, seed=3), MotionSettings(frame_rate=1.0))
    for simulated in (still, two):
        with pytest.raises(SessionError, match="a video shows a moving arm with one LED"):
            write_simulated_images(tmp_path / "s", simulated, Exposure(), video_rate=30.0)
    assert not (tmp_path / "s").exists()


@pytest.mark.no_cover
def test_a_camera_on_the_robot_takes_images_of_leds_but_passes_no_lamps(tmp_path: Path) -> None:
    simulated = simulate(read_rig(find_rig("ur5_handeye")), poses=3, seed=0)
    with pytest.raises(
        SessionError, match=r"lamps and reflections before eye-in-hand cameras.*Leave --distractors out"
    ):
        write_simulated_images(tmp_path / "s", simulated, Exposure(distractors=True))
    assert not (tmp_path / "s").exists()
    assert write_simulated_images(tmp_path / "s", simulated, Exposure()) == 3 * len(simulated.session.leds)
    seen, truth = detect(tmp_path / "s"), truth_of(tmp_path / "s")
    names, found = seen.positions, seen.detections
    assert len(found) >= len(truth) - 1
    for pose, camera, led, uv in zip(found.pose, found.camera, found.led, found.uv, strict=True):
        at = truth[names.poses[pose], names.rig.names[camera], names.led_names[led]]
        assert uv == pytest.approx(at, abs=0.1)


@pytest.mark.no_cover
def test_a_light_arm_is_in_the_images_and_no_part_of_it_is_taken_for_an_led(tmp_path: Path) -> None:
    simulated = simulate(read_rig(find_rig("ur5")), poses=4, seed=3)
    write_simulated_images(tmp_path / "dark", simulated, Exposure())
    write_simulated_images(tmp_path / "light", simulated, Exposure(arm=0.6))
    for path in sorted((tmp_path / "light" / "images").rglob("*.png")):
        light = read_image(path).astype(float)
        dark = read_image(tmp_path / "dark" / path.relative_to(tmp_path / "light")).astype(float)
        assert 0.005 < np.mean(light > dark + 60.0) < 0.3
        assert light.max() < 255.0 or dark.max() == 255.0
    truth, seen = truth_of(tmp_path / "light"), detect(tmp_path / "light")
    found, names = seen.detections, seen.positions
    assert len(found) > 0.6 * len(truth)  # what is before its edges is missed
    for pose, camera, led, uv, sigma in zip(found.pose, found.camera, found.led, found.uv, found.sigma, strict=True):
        at = truth[names.poses[pose], names.rig.names[camera], names.led_names[led]]
        assert np.linalg.norm(uv - at) < max(0.15, 5.0 * sigma)
    with pytest.raises(SessionError, match=r"no arm is 1.5 of white"):
        Exposure(arm=1.5)


def misses(session: Path) -> np.ndarray:
    """How far (S, 2) what is found in a session's images is from where it truly is, in deviations. [px / px]."""
    truth, seen = truth_of(session), detect(session)
    found, names = seen.detections, seen.positions
    assert len(found) > 0.7 * len(truth)
    at = [
        truth[names.label(pose), names.rig.names[camera], names.led_names[point]]
        for pose, camera, point in zip(found.pose, found.camera, found.led, strict=True)
    ]
    return (found.uv - np.array(at)) / np.asarray(found.sigma)[:, None]


@pytest.mark.parametrize("changes", [{"flatness": 2e-3}, {"scale_sigma": 2e-2}], ids=["bent", "of another size"])
def test_a_print_is_in_the_images_as_it_came_out(changes: dict[str, float], tmp_path: Path) -> None:
    rig = read_rig(find_rig("ur5_charuco"))
    printed = replace(rig, targets=tuple(replace(target, **changes) for target in rig.targets))
    simulated = simulate(printed, poses=3, seed=0)
    (of,) = simulated.truth.prints
    assert not of.as_given
    write_simulated_images(tmp_path / "s", simulated, Exposure())
    said = json.loads((tmp_path / "s" / "truth.json").read_text())["prints"]
    assert said == {"board": {"given_too_long": of.given_too_long, "bends": of.bends.tolist()}}
    off = misses(tmp_path / "s")
    assert 0.5 < np.sqrt(np.mean(off**2)) < 2.0
    # As it should have been printed it would be elsewhere by far more.
    flat = replace(simulated.truth, leds=simulate(rig, poses=3, seed=0).truth.leds)
    elsewhere = simulated.truth.pixels(simulated.truth.q) - flat.pixels(simulated.truth.q)
    assert np.nanmax(np.abs(elsewhere)) > 1.0


@pytest.mark.no_cover
def test_of_a_rolling_shutter_what_moves_is_where_it_was_when_its_row_was_taken(tmp_path: Path) -> None:
    rig = read_rig(find_rig("so101_apriltag"))
    cameras = tuple(replace(camera, line_time=4e-5) for camera in rig.rig.cameras)
    rolling = replace(rig, rig=replace(rig.rig, cameras=cameras))
    moving = set_in_motion(simulate(rolling, poses=3, seed=1), MotionSettings(speed=1.0, frame_rate=1.5))
    write_simulated_images(tmp_path / "s", moving, Exposure())
    off = misses(tmp_path / "s")
    assert 0.3 < np.sqrt(np.mean(off**2)) < 2.5
    at_once = moving.truth.pixels(moving.truth.q)[:, 0] - pixels_by_row(moving.truth, moving.truth.moving)
    assert np.nanmax(np.abs(at_once)) > 2.0  # where everything is taken at once


def test_an_led_before_a_rolling_shutter_is_where_it_was_when_its_row_was_taken(
    small: RigDescription, tmp_path: Path
) -> None:
    cameras = tuple(replace(camera, line_time=2e-4) for camera in small.rig.cameras)
    moving = set_in_motion(
        simulate(replace(small, rig=replace(small.rig, cameras=cameras)), poses=3, seed=3),
        MotionSettings(speed=1.0, frame_rate=3.0),
    )
    write_simulated_images(tmp_path / "s", moving, Exposure())
    off = misses(tmp_path / "s")
    assert 0.3 < np.sqrt(np.mean(off**2)) < 2.5
    at_once = moving.truth.pixels(moving.truth.q)[np.arange(len(moving.truth.q)), moving.truth.moving.camera]
    assert np.nanmax(np.abs(at_once - pixels_by_row(moving.truth, moving.truth.moving))) > 2.0


def test_images_never_join_an_older_session(still: Simulated, tmp_path: Path) -> None:
    write_simulated_images(tmp_path / "s", still, Exposure())
    with pytest.raises(OutputError, match=r"there is a truth\.urdf already"):
        write_simulated_images(tmp_path / "s", still, Exposure())


@pytest.mark.parametrize("wrong", [{"sigma": 0.2}, {"sigma": 26.0}, {"peak": 0.0}], ids=str)
def test_an_exposure_that_shows_no_led_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(SessionError, match="no LED has a spot of"):
        Exposure(**wrong)
