"""Where the arm holds LEDs on several links, and what cameras on links and in the world see of them."""

from __future__ import annotations

import csv
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.cameras.rig import Rig
from urdfcal.cli import run
from urdfcal.detection.led_frames import frames_in_base, led_frames
from urdfcal.detection.prediction import Lights, predict
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.session.knowledge import Led
from urdfcal.simulation.images import TRUTH, Exposure, write_simulated_images
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.detection.led_frames import LedFrames
    from urdfcal.session.model import Session

POSES = 8


def simulated(rig: str) -> Session:
    return simulate(read_rig(find_rig(rig)), poses=POSES, seed=3).session


def frames_of(session: Session, camera: int) -> tuple[LedFrames, np.ndarray]:
    """One image for each detection of a camera, and where it shows the LED."""
    seen = session.find(Detections)
    mine = seen.camera == camera
    frames = led_frames(session, frames_in_base(session), camera, seen.pose[mine], seen.led[mine])
    return frames, seen.uv[mine]


@pytest.mark.parametrize("rig", ["tiago_dual", "tiago", "ur5_handeye"])
def test_every_led_is_where_its_link_holds_it_before_its_camera(rig: str) -> None:
    """LEDs on two arms; a camera on the head; a camera on the hand before LEDs in the world."""
    session = simulated(rig)
    for c, camera in enumerate(session.rig.cameras):
        frames, uv = frames_of(session, c)
        lights = Lights(np.arange(len(uv)), uv, np.ones(len(uv)))
        assert frames.known.all()
        prediction = predict(camera, frames.leds, frames.T_mount_link, frames.led, lights)
        assert prediction is not None
        assert prediction.near(lights).all()


def test_an_led_that_nothing_moves_before_its_camera_is_always_in_the_same_place() -> None:
    session = simulated("tiago_dual")
    world = replace(session, leds=(session.leds[0], Led("right", np.array([0.3, 0.1, 1.0]), 0.005, "world")))
    frames, _ = frames_of(world, 0)
    still = frames.led == 1
    assert (frames.known == ~still).all()
    assert np.unique(frames.places[still]).size == 1
    assert np.unique(frames.places[~still]).size == np.count_nonzero(~still)


def test_one_place_of_the_led_rejects_nothing() -> None:
    """An LED on the base before a camera in the world, or beside a camera on the arm."""
    session = simulated("tiago_dual")
    camera, T = session.rig.cameras[0], np.tile(np.eye(4), (20, 1, 1))
    uv = np.array([600.0, 500.0]) + np.random.default_rng(0).normal(0.0, 0.1, (20, 2))
    lights = Lights(np.arange(20), uv, np.ones(20))
    led = Led("led", np.array([0.5, 0.1, 1.0]), 0.005)
    prediction = predict(camera, (led,), T, np.zeros(20, np.intp), lights)
    assert prediction is None or prediction.near(lights).all()


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rig = read_rig(find_rig("tiago_dual"))
    # A third of the resolution: a ninth of the time.
    cameras = [replace(camera, resolution=(427, 342), intrinsics=camera.intrinsics / 3.0) for camera in rig.rig.cameras]
    folder = tmp_path_factory.mktemp("images") / "session"
    data = simulate(replace(rig, rig=Rig(cameras, rig.rig.T_cam_world)), poses=POSES, seed=3)
    write_simulated_images(folder, data, Exposure())
    return folder


def rows(path: Path) -> dict[tuple[str, str, str], np.ndarray]:
    with path.open() as file:
        found = csv.DictReader(file)
        return {(row["pose"], row["camera"], row["led"]): np.array([float(row["u"]), float(row["v"])]) for row in found}


def test_leds_on_both_arms_are_found(images: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["detect", str(images), "--force"]) == 0
    assert "is it on" not in capfd.readouterr().out
    truth, found = rows(images / TRUTH), rows(images / "detections.csv")
    assert found.keys() == truth.keys()
    assert all(np.linalg.norm(uv - truth[key]) < 0.5 for key, uv in found.items())


def test_an_led_declared_on_the_wrong_link_is_named(images: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text = (images / "session.yaml").read_text()
    wrong = images / "wrong.yaml"
    wrong.write_text(text.replace("link: arm_right_tool_link", "link: arm_left_tool_link"))
    assert run(["detect", str(wrong), "--force"]) == 0
    said = " ".join(capfd.readouterr().out.split())
    for camera in ("cam0", "cam1"):
        assert f"camera '{camera}': 0 of {POSES} images show a light where the arm holds LED" in said
    assert "is it on link 'arm_left_tool_link'" in said


def test_an_led_in_a_world_of_unknown_place_is_left_to_the_rays_and_named(
    images: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    wrong = images / "world.yaml"
    wrong.write_text((images / "session.yaml").read_text().replace("link: arm_right_tool_link", "link: world"))
    assert run(["detect", str(wrong), "--force"]) == 0
    assert "the arm does not tell where LED 'right' is: it stands in the world" in " ".join(
        capfd.readouterr().out.split()
    )
    assert {led for *_, led in rows(images / "detections.csv")} == {"left", "right"}
