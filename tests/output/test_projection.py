from __future__ import annotations

import numpy as np
import pytest

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.images import arm_in_images, draw_image, skeleton
from urdfcal.output.palette import CALIBRATED, NOMINAL
from urdfcal.output.placing import joint_frames, place_rows
from urdfcal.pipeline import calibrate
from urdfcal.robot.kinematics import tip_poses
from urdfcal.simulation.simulate import simulate


@pytest.fixture(scope="module", params=["elbow3r", "stanford"])
def calibration(request):
    return calibrate(simulate(read_rig(find_rig(request.param)), seed=1, poses=12).session)


@pytest.mark.parametrize("nominal", [False, True])
@pytest.mark.parametrize("camera", [0, 1])
def test_the_line_ends_at_the_projected_tip(calibration, nominal, camera):
    q = calibration.session.q
    state = calibration.nominal if nominal else calibration.estimate
    placements = None if nominal else calibration.placements
    T = state.T_cam_frame[camera] @ state.T_world_base @ tip_poses(calibration.chain, q, placements)
    uv = arm_in_images(calibration, state, q)[camera]
    np.testing.assert_allclose(uv[:, -1], state.cameras[camera].project(T[:, :3, 3]), atol=1e-6)
    np.testing.assert_array_equal(arm_in_images(calibration, state, q[3:4])[camera], uv[3:4])


def test_the_skeleton_passes_the_dh_product_and_its_stretches_are_d_and_a(calibration):
    table, offsets = calibration.table, calibration.estimate.offsets
    q = calibration.session.q
    corners = skeleton(place_rows(table, offsets, joint_frames(table.chain, calibration.placements, q)).lines)
    for k in (0, 5):
        frames = table.frames(q[k], offsets)
        np.testing.assert_allclose(corners[k, 1:-1:2], frames[:, :3, 3], atol=1e-12)
    lengths = np.linalg.norm(np.diff(corners, axis=1), axis=-1)[:, 1:-1]
    rows = table.nominal + offsets
    slides = np.array([row.type == "prismatic" for row in table.rows])
    np.testing.assert_allclose(lengths[:, 0::2], np.abs(rows[:, 1] + q * slides), atol=1e-12)
    np.testing.assert_allclose(lengths[:, 1::2], np.abs(np.broadcast_to(rows[:, 2], q.shape)), atol=1e-12)


@pytest.mark.no_cover
def test_a_lens_bends_the_line():
    calibration = calibrate(simulate(read_rig(find_rig("elbow3r")), seed=1, poses=12).session)
    uv = arm_in_images(calibration, calibration.estimate, calibration.session.q[:1])[0][0]
    frames = joint_frames(calibration.chain, calibration.placements, calibration.session.q[:1])
    corners = skeleton(place_rows(calibration.table, calibration.estimate.offsets, frames).lines)[0]
    per_stretch = (len(uv) - 1) // (len(corners) - 1)
    longest = int(np.argmax(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    stretch = uv[longest * per_stretch : (longest + 1) * per_stretch + 1]
    along = stretch[-1] - stretch[0]
    off = np.abs(np.cross(np.append(along, 0), np.column_stack([stretch - stretch[0], np.zeros(len(stretch))]))[:, 2])
    assert off.max() / np.linalg.norm(along) > 1e-3


def test_what_is_drawn_is_where_it_should_be_and_nothing_behind_the_camera():
    line = np.array([[10.0, 10.0], [30.0, 10.0], [np.nan, np.nan], [10.0, 40.0], [30.0, 40.0], [1e9, 1e9]])
    other = np.array([[10.0, 25.0], [30.0, 25.0]])
    picture = np.full((60, 50, 3), 7, dtype=np.uint8)
    drawn = draw_image(picture, [("calibrated", line[:5]), ("nominal", other)], [("detected", np.full((1, 2), np.nan))])
    assert drawn.shape == (60, 50, 3)
    np.testing.assert_allclose(drawn[10, 20], CALIBRATED[::-1], atol=30)  # smoothed
    np.testing.assert_allclose(drawn[40, 20], CALIBRATED[::-1], atol=30)
    np.testing.assert_allclose(drawn[25, 20], NOMINAL[::-1], atol=30)
    np.testing.assert_array_equal(drawn[33, 20], [7, 7, 7])
    np.testing.assert_array_equal(picture, 7)
    assert draw_image(picture, [("calibrated", line)], []).shape == (60, 50, 3)
