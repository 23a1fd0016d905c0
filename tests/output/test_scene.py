from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.arrays import inverse
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.findings import Overview
from urdfcal.output.palette import by_sigma
from urdfcal.output.placing import joint_frames, link_frames, place_rows
from urdfcal.output.pose_texts import pose_texts
from urdfcal.output.scene import build_scene, exaggerated, magnification
from urdfcal.output.viewpoint import around, filling, viewpoint
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import PARAMETERS, DHTable
from urdfcal.robot.kinematics import tip_poses
from urdfcal.rotations import matrix_to_quaternion
from urdfcal.simulation.simulate import simulate


def random_transforms(rng, count, angle=np.pi):
    twists = np.column_stack([rng.normal(size=(count, 3)), rng.normal(size=(count, 3))])
    twists[:, 3:] *= rng.uniform(0, angle, (count, 1)) / np.linalg.norm(twists[:, 3:], axis=1, keepdims=True)
    return np.array([pin.exp6(twist).homogeneous for twist in twists])


@pytest.mark.parametrize("rig", ["elbow3r", "panda", "so101", "stanford", "ur5"])
def test_frames_agree_with_the_dh_product_and_the_tip(rig):
    rng = np.random.default_rng(0)
    chain = read_rig(find_rig(rig)).chain
    table = DHTable.from_chain(chain)
    offsets = np.zeros((len(table.rows), 5))
    for i, row in enumerate(table.rows):
        for name in row.free if i + 1 < len(table.rows) else (row.variable,):
            offsets[i, PARAMETERS.index(name)] = rng.normal(0, 0.01)
    q = chain.random_values(5, rng)
    frames = joint_frames(chain, table.placements(offsets), q)
    dh = place_rows(table, offsets, frames).frames
    np.testing.assert_allclose(dh, [table.frames(q_k, offsets) for q_k in q], atol=1e-12)
    tips = tip_poses(chain, q, table.placements(offsets))
    np.testing.assert_allclose(link_frames(frames, chain.tips[0]), tips, atol=1e-12)


def test_exaggeration_goes_nowhere_there_and_further():
    rng = np.random.default_rng(1)
    here = random_transforms(rng, 50)
    step = random_transforms(rng, 50, angle=0.02)
    there = here @ step
    np.testing.assert_allclose(exaggerated(here, there, 0.0), here, atol=1e-12)
    np.testing.assert_allclose(exaggerated(here, there, 1.0), there, atol=1e-12)
    np.testing.assert_allclose(exaggerated(here, here, 500.0), here, atol=1e-10)
    far = exaggerated(here, there, 20.0)
    turned = np.array([pin.exp3(20.0 * pin.log3(T[:3, :3])) for T in step])
    np.testing.assert_allclose(far[:, :3, :3], here[:, :3, :3] @ turned, atol=1e-10)
    np.testing.assert_allclose(far[:, :3, 3], here[:, :3, 3] + 20 * (there - here)[:, :3, 3], atol=1e-10)


def test_quaternions_are_the_rotations_they_came_from():
    rng = np.random.default_rng(2)
    half_turns = [np.diag(d) for d in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
    R = np.concatenate([random_transforms(rng, 200)[:, :3, :3], half_turns, [np.eye(3)]])
    back = [pin.Quaternion(np.array(q)).matrix() for q in matrix_to_quaternion(R)]
    np.testing.assert_allclose(back, R, atol=1e-12)


@pytest.mark.parametrize("length", np.logspace(-4, 0, 30))
def test_enlarged_lengths_reach_but_never_pass_the_target(length):
    factor = magnification(length, 0.1)
    assert factor in {1, 2, 5, 10, 20, 50, 100, 200, 500, 1000}
    assert factor == 1 or factor * length <= 0.1
    assert factor == 1000 or 2.5 * factor * length >= 0.1 * (1 - 1e-12)


def test_no_deviation_is_not_enlarged():
    assert magnification(0.0, 0.1) == 1.0


def test_colours_run_from_green_to_red_and_unpredictable_is_red():
    small, large, unknown = by_sigma(np.array([0.5, 50.0, np.nan]))
    assert small.argmax() == 1
    assert large.argmax() == 0
    np.testing.assert_array_equal(unknown, large)


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", ["elbow3r", "stanford"])
def test_the_arm_and_its_leds_fill_the_view_at_first(rig):
    scene = build_scene(calibrate(simulate(read_rig(find_rig(rig)), seed=3, poses=15).session))
    eye, target = viewpoint(scene)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    assert up[2] > 0.5  # looking across, not down
    points = np.concatenate([scene.frames[..., :3, 3].reshape(-1, 3), scene.leds.measured])
    depth = (points - eye) @ forward
    assert np.all(depth > 0)
    half = np.tan(np.radians(55 / 2))
    assert np.all(np.abs((points - eye) @ up) < half * depth)
    assert np.all(np.abs((points - eye) @ right) < 1.2 * half * depth)
    # The arm and its LEDs fill the view: cameras do not push it into a corner of it.
    filled = [np.ptp((points - eye) @ along / (half * depth)) / 2 for along in (up, right / 1.2)]
    assert max(filled) > 0.7


def test_points_fill_a_view_of_any_shape():
    points = np.random.default_rng(1).normal(size=(200, 3)) * [1.0, 2.0, 0.5]
    for forward in ([1.0, 0.2, -0.4], [-0.3, 1.0, -0.2]):
        for aspect in (1.0, 1.6):
            eye, target = filling(points, np.array(forward), aspect)
            ahead = (target - eye) / np.linalg.norm(target - eye)
            right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
            depth = np.tan(np.radians(55 / 2)) * (points - eye) @ ahead
            assert np.all(depth > 0.0)
            seen = [np.max(np.abs((points - eye) @ of) / depth) for of in (right / aspect, np.cross(right, ahead))]
            assert 0.7 < max(seen) < 1.0


def test_a_cloud_is_in_the_view_from_any_side():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3)) * [1.0, 2.0, 0.5] + [3.0, 0.0, 1.0]
    for towards in rng.normal(size=(20, 3)):
        eye, middle = around(points, towards)
        forward = (middle - eye) / np.linalg.norm(middle - eye)
        np.testing.assert_allclose(forward, -towards / np.linalg.norm(towards))
        away = points - eye
        angle = np.arccos(away @ forward / np.linalg.norm(away, axis=1))
        half = np.radians(55 / 2)
        assert 0.5 * half < angle.max() < half


@pytest.fixture(scope="module")
def calibration():
    return calibrate(simulate(read_rig(find_rig("elbow3r")), seed=0, poses=15).session)


def test_where_base_and_leds_went_astray_together_the_ghost_is_laid_over_the_arm(calibration):
    scene, comparison, far = build_scene(calibration), calibration.comparison, np.array([0.0, 0.2, 0.0])
    assert scene.apart == 0.0
    of = comparison.nominal_arm
    T = of.fit.state[BASE].copy()
    T[:3, 3] += T[:3, :3] @ far
    astray = of.fit.state.replace({BASE: T, LEDS: of.fit.state[LEDS] - far})
    trial = replace(of, fit=replace(of.fit, state=astray))
    moved = replace(calibration, comparison=replace(comparison, nominal_arm=trial))
    over = build_scene(moved)
    assert over.apart == pytest.approx(0.2, abs=0.01)
    off = (over.ghost - over.frames)[..., :3, 3] / over.factor
    assert np.linalg.norm(off, axis=-1).max() < 0.02
    np.testing.assert_allclose(off.mean(axis=(0, 1)), 0.0, atol=1e-9)
    (said, *_), (unsaid, *_) = (
        pose_texts(replace(Overview.of(calibration), scene=each, calibration=of))
        for each, of in ((over, moved), (scene, calibration))
    )
    assert f"the nominal arm fits best {1e3 * over.apart:.3g} mm away, which is no error of the arm" in said
    worst = max(max(led["sigma"]) for led in calibration.to_dict()["leds"].values())
    assert f"sit on their links (± {1e3 * worst:.2g} mm)" in said
    assert "fits best" not in unsaid


def test_the_ghost_is_the_nominal_arm_where_it_fits_the_sightings_best(calibration):
    scene = build_scene(calibration)
    chain, q = calibration.chain, calibration.session.q
    T_base_world = inverse(calibration.estimate.T_world_base)
    nominal = (
        T_base_world
        @ calibration.comparison.nominal_arm.fit.state[BASE]
        @ tip_poses(chain, q)
        @ inverse(chain.T_last_tip)
    )
    calibrated = scene.frames[:, -1, :3, 3]
    expected = calibrated + scene.factor * (nominal[:, :3, 3] - calibrated)
    np.testing.assert_allclose(scene.ghost[:, -1, :3, 3], expected, atol=1e-10)
    assert scene.factor > 1
    closer = np.linalg.norm(scene.leds.predicted - scene.leds.measured, axis=1)
    assert np.median(closer) < np.median(np.linalg.norm(scene.leds.nominal - scene.leds.measured, axis=1))
