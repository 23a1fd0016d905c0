"""Robots that branch, carry a camera, or watch LEDs that stand still: the three rigs of that kind, end to end."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from tests.output.test_recording import Recorded
from urdfcal.arrays import inverse
from urdfcal.cameras.rig import Rig
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.findings import Overview
from urdfcal.output.images import arm_in_images, overlays
from urdfcal.output.placing import RobotPoses
from urdfcal.output.recording import write_recording
from urdfcal.output.report import write_report
from urdfcal.output.scene import build_scene
from urdfcal.output.stream import CORNER
from urdfcal.pipeline import calibrate
from urdfcal.robot.kinematics import link_poses
from urdfcal.session.attachments import CameraMount
from urdfcal.simulation.simulate import simulate

RIGS = ("tiago", "tiago_dual", "ur5_handeye")
POSES = 20


def in_hand(cameras):
    """The rig with a camera in the hand, and as many beside it as there are places for."""
    rig = read_rig(find_rig("ur5_handeye"))
    (camera,), (mount,) = rig.rig.cameras, rig.mounts
    aside = np.eye(4)
    aside[0, 3] = -0.1
    lenses = (camera, replace(camera, name="second"))[:cameras]
    mounts = (mount, CameraMount("second", mount.link))[:cameras]
    return replace(rig, rig=Rig(lenses, (np.eye(4), aside)[:cameras]), mounts=mounts)


def strips(recorded, entity, component):
    """The lines at each pose, each as long as it is."""
    (batch,) = [b for chunk, b in recorded.chunks if chunk.entity_path == entity and component in b.schema.names]
    return {
        pose: [np.array(strip) for strip in row]
        for pose, row in zip(
            [number - 1 for number in batch.column("pose").to_pylist()],
            batch.column(component).to_pylist(),
            strict=True,
        )
    }


@pytest.fixture(scope="module", params=RIGS)
def calibration(request):
    return calibrate(simulate(read_rig(find_rig(request.param)), seed=2, poses=POSES).session)


@pytest.fixture(scope="module")
def overview(calibration):
    return Overview.of(calibration)


@pytest.fixture(scope="module")
def recorded(calibration, overview, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "calibration.rrd"
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # rerun only warns when it cannot log something
        assert write_recording(path, overview) == ()
    return Recorded(path)


@pytest.mark.parametrize("which", ["estimate", "nominal"])
def test_leds_and_cameras_are_where_the_estimate_has_them(calibration, which):
    state, (block,) = getattr(calibration, which), calibration.observations
    places = RobotPoses.of(calibration, state, calibration.session.q)
    camera = block.index["camera"]
    T = inverse(places.T_base_cam[camera, block.pose[:, None]])
    p_base = places.leds[block.pose[:, None], block.index["led"]]
    p_cam = (T[..., :3, :3] @ p_base[..., None])[..., 0] + T[..., :3, 3]
    T_cam_view = state.T_cam_frame[camera]
    fit = calibration.nominal_fit if which == "nominal" else calibration.fit
    links = calibration.problem.links(block.readings, fit.state)
    expected = block.table.points(block, links, fit.state)[1]
    expected = (T_cam_view[..., :3, :3] @ expected[..., None])[..., 0] + T_cam_view[..., :3, 3]
    np.testing.assert_allclose(p_cam[block.valid], expected[block.valid], atol=1e-12)


def test_the_drawn_leds_are_as_their_camera_sees_them(calibration):
    scene, drawn = build_scene(calibration), calibration.snapshot(calibration.comparison.nominal_arm.fit.state)
    places = RobotPoses.of(calibration, drawn, calibration.session.q)
    pixels = scene.pixels
    for s in range(0, len(pixels.pose), 7):
        pose, led, camera = pixels.pose[s], pixels.led[s], pixels.camera[s]
        row = np.flatnonzero((scene.leds.pose == pose) & (scene.leds.led == led))[0]
        seen, expected = (
            inverse(T[camera, pose]) @ np.append(p, 1.0)
            for T, p in ((scene.views, scene.leds.nominal[row]), (places.T_base_cam, places.leds[pose, led]))
        )
        if calibration.session.attachments.camera[camera]:  # the drawn camera sits elsewhere on the same link
            expected = calibration.estimate.T_cam_frame[camera] @ inverse(drawn.T_cam_frame[camera]) @ expected
        np.testing.assert_allclose(seen, expected, atol=1e-9)


@pytest.mark.no_cover
def test_an_led_that_stands_still_is_drawn_in_one_place():
    scene = build_scene(calibrate(simulate(in_hand(1), seed=1, poses=POSES).session))
    for led in range(4):
        rows = scene.leds.led == led
        np.testing.assert_allclose(np.ptp(scene.leds.predicted[rows], axis=0), 0.0, atol=1e-12)
        assert np.ptp(scene.leds.measured[rows], axis=0).max() < 2e-3
    assert np.isnan(scene.leds.covariance).all()


@pytest.mark.no_cover
def test_two_cameras_in_one_hand_triangulate():
    scene = build_scene(calibrate(simulate(in_hand(2), seed=1, poses=POSES).session))
    both = np.isfinite(scene.leds.covariance).all(axis=(1, 2))
    assert both.mean() > 0.5
    off = (scene.leds.predicted - scene.leds.measured)[both]
    sigmas = np.einsum("mi,mij,mj->m", off, np.linalg.inv(scene.leds.covariance[both]), off)
    assert 1.0 < np.median(sigmas) < 5.0  # 2.4 is the median of three squares
    apart = np.linalg.norm(scene.views[0, :, :3, 3] - scene.views[1, :, :3, 3], axis=1)
    np.testing.assert_allclose(apart, 0.1, atol=0.01)


def test_cameras_on_the_robot_move_and_the_others_stand(calibration, recorded):
    frames, estimate = calibration.session.attachments, calibration.estimate
    links = link_poses(calibration.chain, calibration.session.q, frames.tips, calibration.placements)
    for c, camera in enumerate(estimate.cameras):
        entity = f"/base/cameras/{camera.name}"
        frame = frames.camera[c]
        if frame == 0:
            expected = inverse(estimate.T_world_base) @ inverse(estimate.T_cam_frame[c])
            place = recorded.static(entity, "Transform3D:translation")[0]
            np.testing.assert_allclose(place, expected[:3, 3], atol=1e-6)
        else:
            rows = recorded.rows(entity, "Transform3D:translation")
            assert list(rows) == list(range(POSES))
            expected = links[frame - 1] @ inverse(estimate.T_cam_frame[c])
            np.testing.assert_allclose(np.concatenate(list(rows.values())), expected[:, :3, 3], atol=1e-6)
        assert f"{entity}/image" in recorded.entities
        assert f"/base/rays/{camera.name}" in recorded.entities


def test_every_branch_is_recorded(calibration, recorded):
    chain, table = calibration.chain, calibration.table
    for joint in chain.names:
        assert any(name.startswith(f"/base/plots/parameters/{joint}/") for name in recorded.entities) == any(
            np.isfinite(calibration.sigmas()[table.labels.index(joint)])
        )
    for i in range(len(table.labels) + 1):
        assert f"/base/dh/F{i}" in recorded.entities
    bodies = {"tiago": ("head_2_link", "arm_6_link"), "tiago_dual": ("arm_left_5_link", "arm_right_5_link")}
    for link in bodies.get(chain.name, ("forearm_link",)):
        for arm in ("calibrated", "nominal"):
            assert len(recorded.rows(f"/base/{arm}/{link}", "Transform3D:translation")) == POSES


def test_the_arm_in_the_pictures_is_cut_where_no_camera_sees_it(calibration, recorded):
    for c, camera in enumerate(calibration.estimate.cameras):
        uv = arm_in_images(calibration, calibration.estimate, calibration.session.q)[c]
        image = f"/base/cameras/{camera.name}/image"
        for pose, pieces in strips(recorded, f"{image}/arm/calibrated", "LineStrips2D:strips").items():
            if pieces:
                drawn = np.concatenate(pieces) - CORNER
                ends = np.isfinite(uv[pose]).all(axis=1)
                assert len(drawn) <= np.count_nonzero(ends)
                apart = np.linalg.norm(uv[pose][ends][:, None] - drawn, axis=-1).min(axis=0)
                assert np.all(apart < 1e-6 * (1.0 + np.abs(drawn).max()))


@pytest.mark.no_cover
def test_overlay_and_report_are_written(calibration, overview, recorded, tmp_path):
    path = tmp_path / "calibration.rrd"
    write_recording(path, overview)
    assert list(overlays(path, calibration.session.poses[3])[0]) == [c.name for c in calibration.estimate.cameras]
    write_report(tmp_path / "report.html", overview)
    text = (tmp_path / "report.html").read_text()
    for label in calibration.geometry.labels:
        assert label in text
    for tip in calibration.chain.tips:
        assert tip.link in text
    arms = {"tiago_dual": ["arm_left_tool_link", "arm_right_tool_link"]}.get(calibration.chain.name)
    if arms is not None:  # each has its map, here and there
        assert [workspace.link for workspace in overview.workspaces] == arms
        for arm in arms:
            assert f"calibrated, {arm} [mm]" in text
        own = recorded.static(f"/base/workspace/{arms[1]}/nominal", "Points3D:positions")
        np.testing.assert_allclose(own, overview.workspaces[1].tip, atol=1e-6)
    else:
        assert len(overview.workspaces) == 1
    (table,) = recorded.static("/base/texts/rows", "TextDocument:text")
    assert table.count("±") == np.isfinite(calibration.sigmas()).sum()
    following = calibration.table.following
    assert ("after row" in table) is bool(following)
    for number, before in enumerate(following, start=1):
        assert f"\n| {number} | {before or ''} | {calibration.table.labels[number - 1]} |" in table


@pytest.mark.no_cover
def test_a_robot_without_meshes_is_a_stick_figure_with_all_its_limbs(calibration, overview, tmp_path):
    bare = replace(calibration, session=replace(calibration.session, urdf=None))
    write_recording(tmp_path / "stick.rrd", replace(overview, calibration=bare))
    recorded = Recorded(tmp_path / "stick.rrd")
    tips = link_poses(bare.chain, bare.session.q, bare.chain.tips, bare.placements)
    for pose, limbs in strips(recorded, "/base/calibrated/stick\\ figure", "LineStrips3D:strips").items():
        ends = [limb[-1] for limb in limbs]
        np.testing.assert_allclose(ends, [T[pose, :3, 3] for T in tips], atol=1e-6)
