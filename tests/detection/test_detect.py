"""From images to detections: names of files, the choice between lights, and the whole way."""

from __future__ import annotations

import csv
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.cameras.rig import Rig
from urdfcal.cli import run
from urdfcal.detection.association import LightCandidate, associate
from urdfcal.detection.detect import (
    REJECTED,
    Detected,
    count_reasons,
    detect,
    open_images,
    write_debug_images,
    write_detected,
)
from urdfcal.detection.image_index import read_index
from urdfcal.detection.prediction import Lights, predict
from urdfcal.errors import OutputError, SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.images.files import read_image, write_image
from urdfcal.io.folder import read_positions, read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.kinematics import tip_poses
from urdfcal.session.knowledge import Led
from urdfcal.simulation.images import TRUTH, Exposure, write_simulated_images
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.session.model import Positions
    from urdfcal.simulation.truth import Simulated

POSES = 14
AWAY = np.array([3.0, 60.0])


@pytest.fixture(scope="module")
def simulated() -> Simulated:
    rig = read_rig(find_rig("ur5"))
    # Half the resolution: a quarter of the time.
    cameras = [replace(camera, resolution=(640, 512), intrinsics=camera.intrinsics / 2.0) for camera in rig.rig.cameras]
    return simulate(replace(rig, rig=Rig(cameras, rig.rig.T_cam_world)), poses=POSES, seed=3)


@pytest.fixture(scope="module")
def session(simulated: Simulated, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("images") / "session"
    assert write_simulated_images(folder, simulated, Exposure(distractors=True)) == 2 * POSES
    return folder


@pytest.fixture(scope="module")
def detected(session: Path) -> Detected:
    return detect(session)


@pytest.fixture
def positions(session: Path) -> Positions:
    return read_positions(session)


def truth_of(session: Path) -> dict[tuple[str, str], np.ndarray]:
    with (session / TRUTH).open() as file:
        return {(r["pose"], r["camera"]): np.array([float(r["u"]), float(r["v"])]) for r in csv.DictReader(file)}


def test_every_sighting_is_the_led_and_few_are_missed(session: Path, detected: Detected) -> None:
    truth, seen = truth_of(session), detected.detections
    for pose, camera, uv, sigma in zip(seen.pose, seen.camera, seen.uv, seen.sigma, strict=True):
        place = truth[detected.positions.poses[pose], detected.positions.rig.names[camera]]
        assert np.linalg.norm(uv - place) < max(0.1, 5.0 * sigma)
    assert len(seen) >= len(truth) - 2
    assert all(reason for *_, reason in detected.rejected())


def test_that_spots_are_too_large_to_be_measured_well_is_said(
    simulated: Simulated, detected: Detected, tmp_path: Path
) -> None:
    scene = simulated.truth
    cameras = [replace(one, resolution=(320, 256), intrinsics=one.intrinsics / 2.0) for one in scene.cameras]
    small = replace(simulated.session, rig=replace(simulated.session.rig, cameras=tuple(cameras)))
    seen = replace(simulated, session=small, truth=replace(scene, cameras=tuple(cameras)))
    write_simulated_images(tmp_path / "s", seen, Exposure(sigma=9.0))
    said = [text for text in detect(tmp_path / "s").warnings if "darkens" in text]
    assert len(said) == 2
    assert "camera 'cam0': the LED's spots are 9 px wide (sigma)" in said[0]
    assert not any("darkens" in text for text in detected.warnings)


def test_simulated_images_hold_the_session_and_not_its_sightings(session: Path, simulated: Simulated) -> None:
    positions = read_positions(session)
    assert positions.poses == simulated.session.poses
    assert np.array_equal(positions.q, simulated.session.q)
    with pytest.raises(SessionError, match="urdfcal detect"):
        read_session(session)


def test_written_tables_make_it_a_session_and_foreign_ones_are_kept(
    session: Path, detected: Detected, tmp_path: Path
) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    (copy / "images").mkdir()
    for name in ("session.yaml", "cameras.yaml", "joints.csv"):
        (copy / name).write_bytes((session / name).read_bytes())
    (copy / "detections.csv").write_text("mine")
    with pytest.raises(OutputError, match=r"there are detections already.*--force"):
        write_detected(copy, detected)
    assert (copy / "detections.csv").read_text() == "mine"
    (copy / "detections.csv").unlink()
    write_detected(copy, detected)
    with pytest.raises(OutputError, match="there are detections already"):
        write_detected(copy, detected)
    write_detected(copy, detected, force=True)
    read = read_session(copy).find(Detections)
    for name in ("pose", "camera", "led", "uv", "sigma"):
        assert np.array_equal(getattr(read, name), getattr(detected.detections, name))
    rows = list(csv.DictReader((copy / REJECTED).open()))
    assert rows
    assert all(row["reason"] for row in rows)
    read_session(copy, look=pytest.fail)


def test_debug_images_show_every_picture(detected: Detected, tmp_path: Path) -> None:
    write_debug_images(tmp_path / "debug", detected)
    drawings = sorted((tmp_path / "debug").glob("*/*.png"))
    assert len(drawings) == detected.index.count
    assert read_image(drawings[0]).ndim == 3


@pytest.mark.no_cover
def test_calibrate_detects_by_itself_and_says_so(
    simulated: Simulated, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_simulated_images(tmp_path / "s", simulated, Exposure())
    assert run(["calibrate", str(tmp_path / "s"), "-o", str(tmp_path / "out")]) == 0
    said = capfd.readouterr().out
    assert "looking for the LEDs first" in said
    assert f"{2 * POSES} detections in {2 * POSES} images" in said
    assert len(read_session(tmp_path / "s", look=pytest.fail).find(Detections)) == 2 * POSES


def put(folder: Path, *names: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        write_image(folder / name, np.zeros((4, 4), np.uint8))


def with_leds(positions: Positions, *names: str) -> Positions:
    return replace(positions, leds=tuple(Led(name) for name in names))


def test_file_names_say_pose_led_and_dark(positions: Positions, tmp_path: Path) -> None:
    put(tmp_path / "cam0", "01.a.png", "01.b.png", "01.off.png", "02.b.tif", "stray.png")
    put(tmp_path / "cam1")
    put(tmp_path / "cam2")
    album = read_index(tmp_path, with_leds(positions, "a", "b"))
    shots = album.shots[0]
    assert [(shot.pose, shot.led) for shot in shots] == [(0, 0), (0, 1), (1, 1)]
    assert [image.dark is not None for image in album.images[0]] == [True, True, False]
    assert [word for word in ("stray.png", "cam1", "cam2") if not any(word in text for text in album.warnings)] == []


@pytest.mark.parametrize(
    ("leds", "names", "message"),
    [
        (("led",), [], "no image of any pose"),
        (("led",), ["x.png"], "no image of any pose"),
        (("led",), ["01.png", "01.tif"], "the same image as"),
        (("a", "b"), ["01.png"], "does not say which is lit"),
        (("off",), ["01.png"], "Rename it"),
    ],
)
def test_file_names_that_do_not_say_it_are_refused(
    positions: Positions, tmp_path: Path, leds: tuple[str, ...], names: list[str], message: str
) -> None:
    put(tmp_path / "cam0", *names)
    with pytest.raises(SessionError, match=message):
        read_index(tmp_path, with_leds(positions, *leds))


def test_a_session_without_images_says_where_they_belong(positions: Positions, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="images/<camera>/<pose>"):
        read_index(tmp_path / "images", positions)


@pytest.mark.parametrize("known", [True, False])
def test_the_arm_tells_the_led_from_brighter_lights_elsewhere(simulated: Simulated, known: bool) -> None:
    session = simulated.session
    camera, seen = session.rig.cameras[0], session.find(Detections)
    mine = seen.camera == 0
    rng = np.random.default_rng(0)
    count = int(mine.sum())
    strangers = rng.uniform([0, 0], camera.resolution, (count, 2))
    # In every third image the stranger is the brighter one.
    flux = np.where(np.arange(count) % 3 == 0, 20.0, 1.0)
    lights = Lights(
        np.tile(np.arange(count), 2),
        np.concatenate([seen.uv[mine], strangers]),
        np.concatenate([np.full(count, 10.0), flux]),
    )
    led = session.leds[0] if known else Led("led")
    T = tip_poses(session.chain, session.q)[seen.pose[mine]]
    prediction = predict(camera, (led,), T, np.zeros(count, np.intp), lights)
    assert prediction is not None
    near = prediction.near(lights)
    assert near[:count].all()
    far = np.linalg.norm(strangers - seen.uv[mine], axis=1) > 2.0 * prediction.gate
    assert not near[count:][far].any()
    assert (prediction.gate < 40.0).all()


def test_lights_that_disagree_with_the_arm_give_no_prediction(simulated: Simulated) -> None:
    session = simulated.session
    camera = session.rig.cameras[0]
    uv = np.random.default_rng(1).uniform([0, 0], camera.resolution, (POSES, 2))
    lights = Lights(np.arange(POSES), uv, np.ones(POSES))
    T = tip_poses(session.chain, session.q)
    assert predict(camera, session.leds, T, np.zeros(POSES, np.intp), lights) is None


def groups_of(simulated: Simulated) -> list[list[LightCandidate]]:
    seen = simulated.session.find(Detections)
    groups: dict[int, list[LightCandidate]] = {}
    for row, (pose, camera, uv) in enumerate(zip(seen.pose, seen.camera, seen.uv, strict=True)):
        groups.setdefault(int(pose), []).append(LightCandidate(int(camera), row, uv, 10.0))
    return list(groups.values())


def test_rays_decide_between_lights_whatever_their_brightness(simulated: Simulated) -> None:
    groups = groups_of(simulated)
    first = groups[0][0]
    groups[0].append(LightCandidate(first.camera, 1000, first.uv + AWAY, 30.0))
    verdict, warnings = associate(simulated.session.rig, groups)
    assert set(verdict) == {(first.camera, 1000)}
    assert not warnings


def test_a_pair_whose_rays_miss_is_no_sighting(simulated: Simulated) -> None:
    groups = groups_of(simulated)
    first = groups[0][0]
    groups[0][0] = LightCandidate(first.camera, first.row, first.uv + AWAY, 10.0)
    verdict, _ = associate(simulated.session.rig, groups)
    assert set(verdict) == {(c.camera, c.row) for c in groups[0]}


@pytest.mark.parametrize(("factor", "kept"), [(0.35, 1), (0.8, 0)])
def test_of_two_lights_in_one_picture_only_a_much_brighter_one_is_taken(
    simulated: Simulated, factor: float, kept: int
) -> None:
    uv = np.array([200.0, 200.0])
    alone = [LightCandidate(0, 500, uv, 10.0), LightCandidate(0, 501, uv + 50.0, 10.0 * factor)]
    verdict, _ = associate(simulated.session.rig, [*groups_of(simulated), alone])
    assert sum((0, row) not in verdict for row in (500, 501)) == kept
    assert (0, 501) in verdict


def test_cameras_that_stand_elsewhere_decide_nothing_and_are_named(simulated: Simulated) -> None:
    rng = np.random.default_rng(0)
    groups = [
        [LightCandidate(c.camera, c.row, c.uv + 40.0 * rng.standard_normal(2), c.flux) for c in g]
        for g in groups_of(simulated)
    ]
    verdict, warnings = associate(simulated.session.rig, groups)
    assert not verdict
    assert "rays miss each other" in warnings[0]


def test_images_of_the_same_seed_are_the_same(simulated: Simulated, session: Path, tmp_path: Path) -> None:
    write_simulated_images(tmp_path / "again", simulated, Exposure(distractors=True))
    name = "images/cam1/03.png"
    assert (tmp_path / "again" / name).read_bytes() == (session / name).read_bytes()
    assert open_images(session)[1].count == 2 * POSES


def test_reasons_that_differ_in_numbers_are_one_with_their_range() -> None:
    reasons = [
        "the cameras' rays miss each other by 12.3 px",
        "no light at all",
        "the cameras' rays miss each other by 9.5 px",
        "2 dots of 35 seen",
        "3 dots of 35 seen",
        "3 dots of 35 seen",
        "no marker of tag36h11",
    ]
    images = [f"left/{k}" for k in range(len(reasons))]
    assert count_reasons(zip(images, reasons, strict=True)) == (
        "2 to 3 dots of 35 seen (3: left/3, left/4, left/5); "
        "the cameras' rays miss each other by 9.5 to 12.3 px (2: left/0, left/2); "
        "no light at all (1: left/1); no marker of tag36h11 (1: left/6)"
    )
    assert count_reasons((f"left/{k}", "no light at all") for k in range(6)) == (
        "no light at all (6: left/0, left/1, left/2, left/3 ...)"
    )
