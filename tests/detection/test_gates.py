"""What looking for LEDs says and refuses besides its detections, on rendered images."""

from __future__ import annotations

import csv
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.cameras.rig import Rig
from urdfcal.cli import run
from urdfcal.detection.detect import REJECTED, detect, detect_in, open_images, write_detected
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.images.files import read_image, write_image
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.simulation.images import TRUTH, Exposure, write_simulated_images
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.simulation.truth import Simulated

POSES = 10


@pytest.fixture(scope="module")
def simulated() -> Simulated:
    rig = read_rig(find_rig("ur5"))
    # A third of the resolution: a ninth of the time.
    cameras = [replace(camera, resolution=(427, 342), intrinsics=camera.intrinsics / 3.0) for camera in rig.rig.cameras]
    return simulate(replace(rig, rig=Rig(cameras, rig.rig.T_cam_world)), poses=POSES, seed=3)


@pytest.fixture
def session(simulated: Simulated, tmp_path: Path) -> Path:
    """Images of nothing but the LED, on a grey ground with noise."""
    folder = tmp_path / "session"
    write_simulated_images(folder, simulated, Exposure())
    seen, names, rng = simulated.session.find(Detections), simulated.session.rig.names, np.random.default_rng(0)
    for pose, camera, uv in zip(seen.pose, seen.camera, seen.uv, strict=True):
        path = folder / "images" / names[camera] / f"{simulated.session.poses[pose]}.png"
        write_image(path, rng.normal(15.0, 1.0, (342, 427)).round().astype(np.uint8))
        lamp(path, *uv)
    return folder


def lamp(path: Path, u: float, v: float, peak: float = 200.0) -> None:
    """Add a small round light to an image."""
    image = read_image(path)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    spot = peak * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2.0 * 1.5**2))
    write_image(path, np.clip(image + spot, 0.0, 255.0).astype(np.uint8))


def test_pictures_of_an_led_alone_leave_nothing_to_say(session: Path) -> None:
    detected = detect(session)
    assert detected.found == 2 * POSES
    assert detected.warnings == ()
    assert write_detected(session, detected) == [session / "detections.csv", session / REJECTED]


def test_lights_that_stand_still_are_named_with_their_camera_and_left_out(session: Path) -> None:
    for path in (session / "images" / "cam1").iterdir():
        lamp(path, 40, 300)
    detected = detect(session)
    assert detected.found == 2 * POSES
    (warning,) = detected.warnings
    assert "camera 'cam1'" in warning
    assert "stand still" in warning
    assert "(40, 300)" in warning


def test_a_camera_with_few_pictures_is_said_not_to_be_helped_by_the_arm(session: Path) -> None:
    for path in sorted((session / "images" / "cam1").iterdir())[4:]:
        path.unlink()
    detected = detect(session)
    (warning,) = [text for text in detected.warnings if "the arm did not help" in text]
    assert "camera 'cam1'" in warning
    assert detected.found == POSES + 4


def test_a_camera_without_pictures_is_not_looked_through(session: Path) -> None:
    for path in (session / "images" / "cam1").iterdir():
        path.unlink()
    detected = detect(session)
    assert detected.found == POSES
    assert not [text for text in detected.warnings if "the arm did not help" in text]


def test_a_brighter_light_that_the_arm_does_not_carry_is_rejected_with_its_distance(session: Path) -> None:
    """Seen by one camera alone, so that no ray decides; the arm does."""
    for path in (session / "images" / "cam1").iterdir():
        path.unlink()
    paths = sorted((session / "images" / "cam0").iterdir())
    for k, path in enumerate(paths[:3]):
        lamp(path, 60 + 90 * k, 20 + 10 * k, 240.0)
    detected = detect(session)
    assert detected.found == POSES
    reasons = [reason for *_, row, reason in detected.rejected() if row is not None]
    assert sum("px from where the arm holds the LED" in reason for reason in reasons) == 3


def test_a_brighter_light_in_every_image_does_not_hide_the_led_of_the_arm(session: Path) -> None:
    """Seen by one camera alone, so that no ray decides; the arm does."""
    for path in (session / "images" / "cam1").iterdir():
        path.unlink()
    rng = np.random.default_rng(0)
    for path in sorted((session / "images" / "cam0").iterdir()):
        lamp(path, *rng.uniform([20.0, 20.0], [400.0, 320.0]), 230.0)
    assert run(["detect", str(session)]) == 0
    with (session / "detections.csv").open() as file:
        found = {row["pose"]: (float(row["u"]), float(row["v"])) for row in csv.DictReader(file)}
    with (session / TRUTH).open() as file:
        truth = {
            row["pose"]: (float(row["u"]), float(row["v"])) for row in csv.DictReader(file) if row["camera"] == "cam0"
        }
    assert len(found) >= POSES - 1
    assert all(np.hypot(*np.subtract(uv, truth[pose])) < 2.0 for pose, uv in found.items())


def test_an_led_with_a_large_spot_is_found(simulated: Simulated, tmp_path: Path) -> None:
    write_simulated_images(tmp_path / "s", simulated, Exposure(sigma=7.0))
    assert run(["detect", str(tmp_path / "s")]) == 0
    tables = []
    for name in (TRUTH, "detections.csv"):
        with (tmp_path / "s" / name).open() as file:
            rows = csv.DictReader(file)
            tables.append({(row["pose"], row["camera"]): (float(row["u"]), float(row["v"])) for row in rows})
    truth, found = tables
    # Near the border a spot is cut off.
    assert len(found) >= 2 * POSES - 2
    assert all(np.hypot(*np.subtract(uv, truth[key])) < 0.2 for key, uv in found.items())


def test_a_session_without_cameras_is_refused(session: Path) -> None:
    positions, album = open_images(session)
    with pytest.raises(SessionError, match="no cameras are named"):
        detect_in(replace(positions, rig=Rig()), album)


def test_black_pictures_hold_no_led_and_the_summary_says_so(session: Path) -> None:
    for path in (session / "images").glob("*/*.png"):
        write_image(path, np.zeros_like(read_image(path)))
    detected = detect(session)
    assert detected.found == 0
    with pytest.raises(SessionError, match=rf"no LED .* {2 * POSES} images.*no light at all \({2 * POSES}: cam0/01"):
        write_detected(session, detected)
    assert not (session / "detections.csv").exists()
