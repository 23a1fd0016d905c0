from __future__ import annotations

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pinocchio as pin
import pytest
import yaml

from urdfcal.arrays import inverse
from urdfcal.cameras.rig import Rig
from urdfcal.errors import OutputError, SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig, shipped_rigs
from urdfcal.robot.chain import Chain
from urdfcal.robot.dh import PARAMETERS, DHTable
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.mechanism import BASE
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.urdf import Urdf, find_urdf, package_roots
from urdfcal.session.knowledge import Led
from urdfcal.session.obstacle import Obstacle
from urdfcal.session.rig_description import Stand
from urdfcal.simulation.planning import CollisionChecker
from urdfcal.simulation.scene import look_at
from urdfcal.simulation.simulate import draw_offsets, simulate, write_simulated

RIGS = ("elbow3r", "panda", "so101", "stanford", "ur5")
FACTORY = Path(__file__).parents[3] / "shared" / "data" / "ur_factory_deltas.json"


@pytest.fixture(scope="module")
def rig():
    return read_rig(find_rig("elbow3r"))


@pytest.fixture(scope="module")
def rigs():
    return {name: read_rig(find_rig(name)) for name in RIGS}


@pytest.fixture(scope="module")
def quiet(rigs):
    """Every shipped rig's session, without pixel noise."""
    return {name: simulate(rig, seed=3, pixel=0.0) for name, rig in rigs.items()}


def independent_pixels(simulated, cameras):
    """The LED by Pinocchio on the whole true URDF and OpenCV on the numbers of cameras.yaml."""
    session, truth = simulated.session, simulated.truth
    model = pin.buildModelFromXML(truth.urdf.decode())
    data = model.createData()
    base, tip = (
        model.getFrameId(link, pin.FrameType.BODY) for link in (session.chain.base_link, session.chain.tip_link)
    )
    T_cam_world, uv = np.eye(4), []
    for k, entry in enumerate(cameras.values()):
        T_cam_world = np.array(entry["T_cn_cnm1"]) @ T_cam_world if k else T_cam_world
        T = T_cam_world @ truth.T_world_base
        fx, fy, cx, cy = entry["intrinsics"]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        rows = session.find(Detections).camera == k
        points = []
        for pose, led in zip(session.find(Detections).pose[rows], session.find(Detections).led[rows], strict=True):
            q = pin.neutral(model)
            for name, value in zip(session.chain.names, truth.q[pose], strict=True):
                joint = model.joints[model.getJointId(name)]
                q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if joint.nq == 2 else value
            pin.framesForwardKinematics(model, data, q)
            points.append(data.oMf[base].actInv(data.oMf[tip]).act(truth.leds[led]))
        distortion = np.array(entry["distortion_coeffs"])
        uv.append(cv2.projectPoints(np.array(points), cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, distortion)[0][:, 0])
    return uv


@pytest.mark.parametrize("name", RIGS)
def test_detections_are_those_of_the_true_robot_by_an_independent_path(quiet, rigs, name):
    seen = quiet[name].session.find(Detections)
    cameras = yaml.safe_load((rigs[name].folder / "cameras.yaml").read_text())
    for k, uv in enumerate(independent_pixels(quiet[name], cameras)):
        np.testing.assert_allclose(seen.uv[seen.camera == k], uv, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", RIGS)
def test_poses_keep_inside_the_limits_and_use_their_range(quiet, name):
    q, joints = quiet[name].truth.q, quiet[name].session.chain.joints
    lower, upper = np.array([(joint.lower, joint.upper) for joint in joints]).T
    assert ((q > lower) & (q < upper)).all()
    turns = upper - lower > 2 * np.pi
    assert (np.abs(q[:, turns]) < np.pi).all()
    assert (np.ptp(q, axis=0) > 0.6 * np.minimum(upper - lower, 2 * np.pi)).all()


@pytest.mark.parametrize("name", RIGS)
def test_every_camera_sees_the_led_with_margin_and_all_over_its_image(quiet, name):
    seen, cameras = quiet[name].session.find(Detections), quiet[name].session.rig.cameras
    assert len(seen) == 2 * 50
    for k, camera in enumerate(cameras):
        uv = seen.uv[seen.camera == k]
        assert camera.in_image(uv, margin=10.0).all()
        column, row = (3 * uv / camera.resolution).astype(int).T
        counts = np.bincount(3 * row + column, minlength=9)
        assert np.count_nonzero(counts) >= 8
        assert counts.max() <= 15


@pytest.mark.parametrize("name", RIGS)
def test_nothing_was_left_unchecked(quiet, name):
    assert quiet[name].session.warnings == ()


@pytest.mark.parametrize("name", RIGS)
def test_the_true_tip_is_millimetres_from_the_nominal_one(quiet, name):
    session, truth = quiet[name].session, quiet[name].truth
    q = session.chain.random_values(200, np.random.default_rng(0))
    nominal, true = (tip_poses(session.chain, q, p)[:, :3, 3] for p in (session.chain.placements, truth.placements))
    rms = np.sqrt(np.mean(np.sum((true - nominal) ** 2, axis=1)))
    assert 0.5e-3 < rms < 8e-3


def test_ur5_collides_with_nothing_by_its_meshes_and_the_makers_list_of_pairs(quiet):
    session = quiet["ur5"].session
    path = find_urdf(session.urdf_reference)
    model = pin.buildModelFromUrdf(str(path))
    folders = [str(folder) for folder in package_roots()]
    geometry = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.COLLISION, package_dirs=folders)
    geometry.addAllCollisionPairs()
    pin.removeCollisionPairs(model, geometry, str(path.parents[1] / "srdf" / "ur5_gripper.srdf"))
    assert len(geometry.collisionPairs) > 5
    data, placed = model.createData(), geometry.createData()
    for q in quiet["ur5"].truth.q:
        assert not pin.computeCollisions(model, data, geometry, placed, q, True)
        assert min(data.oMi[i].translation[2] for i in range(1, model.njoints)) > -0.03


def test_the_same_seed_gives_the_same_session(rig):
    first, second = (simulate(rig, seed=5, outliers=0.1) for _ in range(2))
    np.testing.assert_array_equal(first.session.q, second.session.q)
    np.testing.assert_array_equal(first.session.find(Detections).uv, second.session.find(Detections).uv)
    np.testing.assert_array_equal(first.truth.outliers, second.truth.outliers)
    assert first.truth.urdf == second.truth.urdf


def test_another_seed_gives_another_robot_and_other_poses(rig):
    first, second = (simulate(rig, seed=seed) for seed in (5, 6))
    assert not np.isclose(first.session.q, second.session.q).any(axis=1).all()
    assert first.truth.urdf != second.truth.urdf
    assert not np.allclose(first.truth.leds, second.truth.leds)


def test_pixel_noise_changes_nothing_but_the_pixels(rig):
    clean, quiet, loud = (simulate(rig, seed=7, pixel=pixel) for pixel in (0.0, 0.2, 0.4))
    np.testing.assert_array_equal(quiet.session.q, loud.session.q)
    np.testing.assert_array_equal(quiet.truth.T_world_base, loud.truth.T_world_base)
    assert quiet.truth.urdf == loud.truth.urdf
    noise, twice = (s.session.find(Detections).uv - clean.session.find(Detections).uv for s in (quiet, loud))
    np.testing.assert_allclose(twice, 2 * noise, atol=1e-9)
    assert 0.17 < noise.std() < 0.23
    assert quiet.session.noise.pixel == 0.2
    assert (quiet.session.find(Detections).sigma == 0.2).all()
    assert clean.session.noise.pixel == rig.noise.pixel


def test_readings_are_off_by_the_noise_that_is_declared(rig):
    simulated = simulate(rig, seed=8, poses=200)
    error = simulated.session.q - simulated.truth.q
    assert 0.9 < error.std() / rig.noise.joint < 1.1


def test_the_leds_and_the_stand_are_not_quite_where_they_were_meant_to_be(rig):
    runs = [simulate(rig, seed=seed, poses=3).truth for seed in range(12)]
    leds = np.array([truth.leds[0] - rig.leds[0].position for truth in runs])
    assert 0.6 < leds.std() / rig.leds[0].sigma < 1.4
    drift = [look_at(rig.stand.position, rig.stand.look_at) @ truth.T_world_base for truth in runs]
    assert all(1e-4 < np.linalg.norm(T[:3, 3]) < 0.03 for T in drift)
    exact = replace(rig, leds=(Led("led", rig.leds[0].position, 0.0),))
    np.testing.assert_array_equal(simulate(exact, seed=1, poses=3).truth.leds, [rig.leds[0].position])


def test_no_error_leaves_the_drawing_byte_for_byte(rigs):
    for rig in (rigs["elbow3r"], rigs["ur5"]):
        simulated = simulate(rig, seed=9, poses=3, error_scale=0.0)
        assert simulated.truth.urdf == rig.urdf.data
        assert not simulated.truth.offsets.any()


def test_the_error_scale_multiplies_every_offset(rig):
    once, thrice = (simulate(rig, seed=9, poses=3, error_scale=scale).truth for scale in (1.0, 3.0))
    np.testing.assert_allclose(thrice.offsets, 3 * once.offsets)
    np.testing.assert_array_equal(thrice.q, once.q)


def test_outliers_are_as_many_as_asked_for_moved_visibly_and_still_in_the_image(rig):
    good, bad = (simulate(rig, seed=10, outliers=share) for share in (0.0, 0.12))
    moved = np.linalg.norm(bad.session.find(Detections).uv - good.session.find(Detections).uv, axis=1)
    np.testing.assert_array_equal(np.flatnonzero(moved), bad.truth.outliers)
    assert len(bad.truth.outliers) == 12
    assert moved[bad.truth.outliers].min() >= 5.0
    assert moved.max() <= 200.0
    seen = bad.session.find(Detections)
    for k, camera in enumerate(bad.session.rig.cameras):
        assert camera.in_image(seen.uv[seen.camera == k]).all()


@pytest.mark.parametrize("name", RIGS)
def test_only_what_an_led_can_tell_is_disturbed(rigs, name):
    table = DHTable.from_chain(rigs[name].chain)
    offsets = draw_offsets(table, np.random.default_rng(1))
    free = np.array([[parameter in row.free for parameter in PARAMETERS] for row in table.rows])
    free[0, [PARAMETERS.index("theta"), PARAMETERS.index("d")]] = False
    free[-1] = False
    np.testing.assert_array_equal(offsets != 0.0, free)
    for row, values in zip(table.rows[1:-1], offsets[1:-1], strict=True):
        zero = abs(values[PARAMETERS.index(row.variable)])
        assert 0.2e-3 <= zero <= 0.8e-3 if row.type == "prismatic" else 1e-3 <= zero <= 5e-3


def test_errors_spread_as_documented(rigs):
    """Root mean squares over five Universal Robots, in m and rad, of rows that are parallel and of others."""
    table = DHTable.from_chain(rigs["ur5"].chain)
    rng = np.random.default_rng(2)
    rms = np.sqrt(np.mean(np.square([draw_offsets(table, rng) for _ in range(4000)]), axis=0))
    expected = {("d", 3): 0.76e-3, ("a", 1): 0.17e-3, ("a", 3): 0.17e-3, ("alpha", 3): 0.74e-3, ("alpha", 1): 4.5e-3,
                ("beta", 1): 1.5e-3, ("theta", 2): np.sqrt((5**3 - 1) / 12) * 1e-3}  # fmt: skip
    for (name, row), value in expected.items():
        assert rms[row, PARAMETERS.index(name)] == pytest.approx(value, rel=0.05), (name, row)


@pytest.mark.parametrize("name", ["tiago", "tiago_dual"])
def test_the_rows_of_a_tree_are_drawn_branch_by_branch(name):
    table = rows_of(read_rig(find_rig(name)).chain)
    offsets = draw_offsets(table, np.random.default_rng(0))
    assert offsets.shape == (len(table.labels), len(PARAMETERS))
    drawn = iter(zip(table.rows, offsets, strict=True))
    for branch in table.chain.branches:
        row, values = next(drawn)
        assert row.mount == (branch[0] != 0)
        if mounted := row.mount:
            free = [parameter in row.free and parameter != "beta" for parameter in PARAMETERS]
            assert ((values != 0.0) == free).all()
            row, values = next(drawn)
        free = [p in row.free and (mounted or p not in ("theta", "d")) for p in PARAMETERS]
        assert ((values != 0.0) == free).all()
        *_, (last, values) = islice(drawn, len(branch) - 1)
        assert last.last
        assert not values.any()


@pytest.mark.skipif(not FACTORY.exists(), reason="needs ../shared/data/ur_factory_deltas.json")
def test_errors_spread_as_those_of_real_robots(rigs):
    table = DHTable.from_chain(rigs["ur5"].chain)
    rng = np.random.default_rng(2)
    drawn = np.array([draw_offsets(table, rng) for _ in range(2000)])
    real = np.array([robot["delta_theta_d_a_alpha_beta"] for robot in json.loads(FACTORY.read_text())])
    parallel, others = [1, 2], [0, 3, 4]

    def rms(offsets, rows, name):
        values = offsets[:, rows, PARAMETERS.index(name)]
        return np.sqrt(np.mean(values**2))

    for rows, name in ((parallel, "alpha"), (parallel, "beta"), (others, "alpha"), (parallel + others, "a")):
        assert rms(drawn, rows, name) == pytest.approx(rms(real, rows, name), rel=0.1), (rows, name)
    assert rms(drawn, [3, 4], "d") == pytest.approx(rms(real, others, "d"), rel=0.1)


ODD = """<?xml version="1.0"?>
<robot name="odd">
  <link name="world"/><link name="cart"/><link name="a"/><link name="b"/><link name="mount"/><link name="c"/>
  <link name="d"/><link name="tip"/>
  <joint name="cart" type="prismatic"><origin xyz="0.3 -0.2 0.1" rpy="0.2 -0.1 0.5"/>
    <parent link="world"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="pan" type="continuous"><origin xyz="0 0 0.3"/>
    <parent link="cart"/><child link="a"/><axis xyz="0 0 1"/></joint>
  <joint name="lift" type="revolute"><origin xyz="0.05 0 0.1"/>
    <parent link="a"/><child link="b"/><axis xyz="0 0.6 0.8"/>
    <limit lower="-20" upper="1.5" effort="1" velocity="1"/></joint>
  <joint name="mount" type="fixed"><origin xyz="0.3 0 0" rpy="0.4 0 0"/><parent link="b"/><child link="mount"/></joint>
  <joint name="follow" type="revolute"><parent link="mount"/><child link="c"/><axis xyz="0 1 0"/>
    <mimic joint="lift" multiplier="-0.5" offset="0.2"/>
    <limit lower="-1.5" upper="1.5" effort="1" velocity="1"/></joint>
  <joint name="out" type="prismatic"><origin xyz="0.2 0 0"/><parent link="c"/><child link="d"/><axis xyz="1 0 0"/>
    <limit lower="-0.1" upper="0.1" effort="1" velocity="1"/></joint>
  <joint name="tip" type="fixed"><origin xyz="0.1 0 0.02" rpy="0 1 0"/><parent link="d"/><child link="tip"/></joint>
</robot>
"""


def test_any_chain_will_do_with_a_base_inside_the_tree_mimic_and_endless_joints(rig):
    urdf = Urdf.parse(ODD.encode())
    odd = replace(rig, chain=Chain.from_urdf(urdf, "tip", "cart"), urdf=urdf, urdf_reference="odd.urdf")
    simulated = simulate(odd, seed=11, pixel=0.0)
    q = simulated.truth.q
    lower, upper = np.array([(joint.lower, joint.upper) for joint in odd.chain.joints]).T
    assert ((q > lower) & (q < upper)).all()
    np.testing.assert_allclose(q[:, 2], -0.5 * q[:, 1] + 0.2)
    np.testing.assert_allclose(simulated.session.q[:, 2], -0.5 * simulated.session.q[:, 1] + 0.2)
    assert q[:, 1].min() > -2 * np.pi
    cameras = yaml.safe_load((rig.folder / "cameras.yaml").read_text())
    seen = simulated.session.find(Detections)
    for k, uv in enumerate(independent_pixels(simulated, cameras)):
        np.testing.assert_allclose(seen.uv[seen.camera == k], uv, rtol=0, atol=1e-6)
    (warning,) = simulated.session.warnings
    assert "no collision geometry" in warning


def test_a_missing_mesh_is_a_warning_and_not_the_end(rig):
    data = rig.urdf.data.replace(b'<cylinder radius="0.04" length="0.02"/>', b'<mesh filename="gone.stl"/>')
    simulated = simulate(replace(rig, urdf=Urdf.parse(data)), seed=12, poses=5)
    (warning,) = simulated.session.warnings
    assert warning.startswith("the poses were not checked for collisions: URDF: its collision geometry cannot")
    assert "gone.stl" in warning


def test_without_a_urdf_poses_are_not_checked(rig):
    simulated = simulate(replace(rig, urdf=None), seed=12, poses=3)
    assert simulated.session.warnings == ("no URDF: the poses were not checked for collisions",)
    assert simulated.truth.urdf == b""


def test_several_leds_are_all_in_view(rig):
    leds = (*rig.leds, Led("second", np.array([0.0, -0.05, -0.06]), 0.001), Led("third", np.array([0.0, 0.0, 0.08])))
    simulated = simulate(replace(rig, leds=leds), seed=13, poses=20)
    assert len(simulated.session.find(Detections)) == 20 * 2 * 3
    assert simulated.truth.leds.shape == (3, 3)


WALL = """<?xml version="1.0"?>
<robot name="wall">
  <link name="world"/>
  <link name="base"/>
  <link name="screen"><collision><geometry><box size="0.02 1 1"/></geometry></collision></link>
  <link name="arm"><collision><origin xyz="0 0 0.2"/><geometry><box size="0.05 0.05 0.4"/></geometry></collision></link>
  <link name="hand"/>
  <link name="palm"><collision><geometry><box size="0.05 0.05 0.2"/></geometry></collision></link>
  <joint name="base" type="revolute"><origin xyz="1 2 3" rpy="0.5 0.6 0.7"/><parent link="world"/><child link="base"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="screen" type="revolute"><origin xyz="0.5 0 0.5"/><parent link="base"/><child link="screen"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="one" type="revolute"><origin xyz="0 0 0.3"/><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="two" type="revolute"><origin xyz="0 0 0.4"/><parent link="arm"/><child link="hand"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="palm" type="prismatic"><origin xyz="0 0 0.1"/><parent link="hand"/><child link="palm"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>
"""


PALM = '<link name="palm"><collision><geometry><box size="0.05 0.05 0.2"/></geometry></collision></link>'


def checker_of(text, cameras=1, led=(0.0, 0.06, 0.1)):
    urdf = Urdf.parse(text.encode())
    chain = Chain.from_urdf(urdf, "hand", "base")
    return CollisionChecker(chain, urdf, [(1, np.array(led))], [(BASE, np.full(3, 9.0))] * cameras)


def test_the_first_link_is_checked_against_the_table_too():
    without_palm = checker_of(WALL.replace(PALM, '<link name="palm"/>'))
    assert without_palm.is_free(np.array([-2.2, 2.2]))
    assert not without_palm.is_free(np.array([-3.0, 3.0]))  # the LED is above the table, the arm reaches into it


def test_an_led_is_carried_by_solids_of_its_own_joint_only():
    # In the hand's frame the LED is where the arm has its solid in its own frame.
    folded = checker_of(WALL.replace(PALM, '<link name="palm"/>'), led=(0.0, 0.0, 0.25))
    assert folded.is_seen(np.array([0.0, 2.9]), np.array([[0.3, 1.0, 0.5]]))
    assert not folded.is_seen(np.array([0.0, 2.9]), np.array([[-1.0, 0.0, 0.5]]))


@pytest.mark.parametrize(("joint", "seen"), [(1, True), (BASE, False)])
def test_of_its_own_link_less_is_kept_of_a_ray_but_not_of_what_stands(joint, seen):
    # A ray passes 5 mm beside the palm, on which the LED is, or beside a box as an LED that stands: 6 mm are kept.
    urdf = Urdf.parse(WALL.encode())
    chain = Chain.from_urdf(urdf, "hand", "base")
    led, here = {1: ([0.0, 0.03, 0.05], [0.0, 0.03, 0.75]), BASE: ([0.5, -2.0, 0.5],) * 2}[joint]
    box = Obstacle("box", np.array([0.05, 0.05, 0.2]), np.array([0.5, -2.03, 0.7]))
    checker = CollisionChecker(chain, urdf, [(joint, np.array(led))], [(BASE, np.full(3, 9.0))], 0.02, [box])
    above, beyond = (np.add(here, of)[None] for of in ([0.0, 0.0, 2.0], [0.0, -0.6, 2.0]))
    assert checker.is_seen(np.zeros(2), above) == seen
    assert not checker.is_seen(np.zeros(2), beyond)


def test_an_arm_keeps_clear_of_what_stands_beside_it_and_of_the_table():
    checker = checker_of(WALL)
    upright, back, into_wall, into_table = np.array([[0.0, 0.0], [-1.4, 0.0], [1.2, 0.4], [-2.2, -0.6]])
    assert checker.is_free(upright)
    assert checker.is_free(back)
    assert not checker.is_free(into_wall)
    assert not checker.is_free(into_table)


def test_what_overlaps_in_every_pose_is_nominal_so_and_no_collision():
    size = 'size="0.02 1 1"'
    assert size in WALL
    assert checker_of(WALL.replace(size, 'size="9 9 1.8"')).is_free(np.array([1.2, 0.4]))


def test_an_led_behind_the_wall_or_the_hand_is_not_seen():
    checker = checker_of(WALL)
    folded = np.array([-1.0, -1.2])  # the hand low behind the wall
    beside, beyond = np.array([[-0.5, 2.0, 0.5]]), np.array([[2.0, 0.0, 0.4]])
    assert checker.is_seen(folded, beside)
    assert not checker.is_seen(folded, beyond)
    assert not checker_of(WALL, cameras=2).is_seen(folded, np.concatenate([beside, beyond]))
    upright = np.array([0.0, 0.0])
    assert checker.is_seen(upright, np.array([[0.0, 2.0, 0.8]]))
    assert not checker.is_seen(upright, np.array([[0.0, -2.0, 0.8]]))


def test_an_led_that_the_drawing_puts_inside_its_link_is_not_hidden_by_it():
    wide = WALL.replace('<box size="0.05 0.05 0.2"/>', '<box size="0.15 0.15 0.2"/>')
    assert checker_of(wide).is_seen(np.array([0.0, 0.0]), np.array([[0.0, -2.0, 0.8]]))


def test_a_camera_stands_upright_where_it_is_put():
    position, target = np.array([1.5, -0.3, 0.9]), np.array([0.2, 0.1, 0.4])
    T = look_at(position, target)
    np.testing.assert_allclose(T @ inverse(T), np.eye(4), atol=1e-14)
    np.testing.assert_allclose((inverse(T) @ [*target, 1.0])[:2], 0.0, atol=1e-14)
    assert (inverse(T) @ [*target, 1.0])[2] == pytest.approx(np.linalg.norm(target - position))
    assert T[2, 0] == pytest.approx(0.0)  # x level
    assert T[2, 1] < 0.0  # y down
    down = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3))
    assert np.linalg.det(down[:3, :3]) == pytest.approx(1.0)


def test_a_written_session_reads_back_without_a_warning_and_its_truth_lies_beside(rigs, tmp_path):
    for name in ("elbow3r", "stanford", "ur5"):
        simulated = simulate(rigs[name], seed=14, outliers=0.04)
        folder = tmp_path / name
        write_simulated(folder, simulated)
        session = read_session(folder)
        assert session.warnings == ()
        np.testing.assert_array_equal(session.q, simulated.session.q)
        np.testing.assert_array_equal(session.find(Detections).uv, simulated.session.find(Detections).uv)
        assert session.urdf.data == rigs[name].urdf.data
        assert (folder / "truth.urdf").read_bytes() == simulated.truth.urdf != session.urdf.data
        assert not set(session.sha256) & {"truth.urdf", "truth.json"}

        truth = json.loads((folder / "truth.json").read_text())
        assert (truth["seed"], truth["poses"], truth["error_scale"]) == (14, 50, 1.0)
        np.testing.assert_array_equal(truth["T_world_base"], simulated.truth.T_world_base)
        np.testing.assert_array_equal([row["offset"] for row in truth["dh"]], simulated.truth.offsets.ravel())
        assert len(truth["outliers"]) == 4
        row = simulated.truth.outliers[0]
        pose, camera = (
            session.poses[session.find(Detections).pose[row]],
            session.rig.names[session.find(Detections).camera[row]],
        )
        assert truth["outliers"][0] == {"pose": pose, "camera": camera, "led": "led"}


def test_a_session_is_not_overwritten(rig, tmp_path):
    simulated = simulate(rig, seed=15, poses=3)
    write_simulated(tmp_path / "session", simulated)
    before = {path.name: path.read_bytes() for path in (tmp_path / "session").iterdir()}
    with pytest.raises(OutputError):
        write_simulated(tmp_path / "session", simulate(rig, seed=16, poses=3))
    (tmp_path / "session" / "truth.json").unlink()
    (tmp_path / "session" / "truth.urdf").unlink()
    with pytest.raises(OutputError):
        write_simulated(tmp_path / "session", simulate(rig, seed=16, poses=3))
    left = {path.name: path.read_bytes() for path in (tmp_path / "session").iterdir()}
    assert left == {name: data for name, data in before.items() if not name.startswith("truth")}


def test_a_truth_that_would_cover_the_drawing_is_refused(rig, tmp_path):
    simulated = simulate(replace(rig, urdf_reference="../before/truth.urdf"), seed=17, poses=3)
    with pytest.raises(OutputError, match=r"truth\.urdf"):
        write_simulated(tmp_path / "session", simulated)
    assert not (tmp_path / "session").exists()


def test_progress_is_told_of_every_pose(rig):
    steps = []
    simulate(rig, seed=18, poses=7, progress=steps.append)
    assert sum(steps) == 7


@pytest.mark.no_cover
def test_a_stand_that_looks_away_says_how_far_it_got(rig):
    away = replace(rig, stand=Stand(rig.stand.position, 2 * rig.stand.position - rig.stand.look_at))
    with pytest.raises(SessionError, match=r"0 of 50 poses found: of [\d]+ random ones .* in 0") as error:
        simulate(away, seed=19)
    assert "stand" in str(error.value)
    assert "fewer poses" in error.value.remedy


@pytest.mark.parametrize(
    "wrong",
    [
        {"seed": -1},
        {"poses": 2},
        {"pixel": -0.1},
        {"pixel": np.nan},
        {"pixel": np.inf},
        {"error_scale": -1.0},
        {"error_scale": np.inf},
        {"outliers": 1.5},
        {"outliers": -0.1},
    ],
    ids=str,
)
def test_arguments_that_make_no_sense_are_named(rig, wrong):
    (name,) = wrong
    with pytest.raises(SessionError, match=f"^simulate: {name} is"):
        simulate(rig, **{"seed": 1, **wrong})


def test_arguments_at_the_ends_of_their_ranges_are_allowed(rig):
    simulated = simulate(rig, seed=0, poses=3, pixel=0.0, error_scale=0.0, outliers=1.0)
    assert len(simulated.truth.outliers) == len(simulated.session.find(Detections))


def test_a_rig_that_leaves_open_what_must_be_simulated_is_refused(rig):
    for lacking, named in (
        (replace(rig, leds=(Led("lamp"),)), "lamp"),
        (replace(rig, rig=Rig(rig.rig.cameras, (np.eye(4), None))), "cam1"),
        (replace(rig, rig=Rig()), "cameras"),
    ):
        with pytest.raises(SessionError, match=named):
            simulate(lacking, seed=1)


def test_rigs_are_found_by_name_folder_and_file(tmp_path):
    others = "panda_handeye", "panda_sockets", "so101_apriltag", "tiago", "tiago_dual", "ur5_charuco", "ur5_handeye"
    assert tuple(shipped_rigs()) == tuple(sorted({*RIGS, "ur5", *others}))
    folder = find_rig("ur5")
    assert (folder / "rig.yaml").is_file()
    assert find_rig(folder) == find_rig(str(folder / "rig.yaml")) == folder
    with pytest.raises(SessionError, match=r"ur6.*no such rig.*elbow3r, panda, panda_handeye, panda_sockets, so101"):
        find_rig("ur6")
    with pytest.raises(SessionError, match=r"has no rig\.yaml"):
        find_rig(tmp_path)


def test_the_elbow_is_the_papers():
    rows = DHTable.from_chain(read_rig(find_rig("elbow3r")).chain).nominal
    expected = [[0, 0.35, 0, np.pi / 2, 0], [0, 0, 0.40, 0, 0], [0, 0, 0.35, 0, 0]]
    np.testing.assert_allclose(rows, expected, atol=1e-15)


def test_the_stanford_arm_is_pauls(rigs):
    chain = rigs["stanford"].chain
    rows = [(0.412, 0, -90), (0.154, 0, 90), (None, 0.0203, 0), (0, 0, -90), (0, 0, 90), (0.1, 0, 0)]
    q = chain.random_values(20, np.random.default_rng(0))
    for q_k, T in zip(q, tip_poses(chain, q), strict=True):
        F = np.eye(4)
        for value, (d, a, alpha) in zip(q_k, rows, strict=True):
            theta, d = (-np.pi / 2, value) if d is None else (value, d)
            c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
            F = F @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        np.testing.assert_allclose(T, F, atol=1e-12)
