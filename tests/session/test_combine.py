"""Several sessions of one arm as one: what is whose, what is the same, and what contradicts."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from urdfcal.cameras.rig import CameraSigma
from urdfcal.errors import OutputError, SessionError
from urdfcal.estimation.joint_models.base import Readings
from urdfcal.estimation.joint_models.compliance import Compliance
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.io.writing import write_session
from urdfcal.robot.chain import read_mechanism
from urdfcal.session.attachments import CameraMount
from urdfcal.session.combine import combine
from urdfcal.session.knowledge import Estimate, Led, LedDistance, Noise, Payload, Tolerances
from urdfcal.simulation.motion import MotionSettings, set_in_motion

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.session.model import Session

# A calibration of two cameras, with correlations: nine parameters, then nine and a pose.
_COUNT = (9, 15)


@pytest.fixture
def two(simulated: Callable) -> tuple[Session, Session]:
    """The same rig, twice."""
    return simulated("ur5", poses=6).session, simulated("ur5", poses=5, seed=1).session


def known(session: Session, seed: int) -> Session:
    """The same with cameras that were calibrated to correlated standard deviations."""
    rng, total = np.random.default_rng(seed), sum(_COUNT)
    factor = np.eye(total) + 0.1 * rng.normal(size=(total, total))
    correlation = factor @ factor.T
    correlation /= np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
    sigmas = (
        CameraSigma(np.full(9, 0.1), None, correlation[:9, :9]),
        CameraSigma(np.full(9, 0.1), np.full(6, 1e-3), correlation[9:]),
    )
    cameras = tuple(
        replace(camera, distortion_model="radtan", distortion=np.full(5, 1e-3 * seed)) for camera in session.rig.cameras
    )
    return replace(session, rig=replace(session.rig, cameras=cameras, sigmas=sigmas))


def test_one_session_is_itself(two: tuple[Session, Session]) -> None:
    assert combine({"a": two[0]}) is two[0]


def test_each_has_its_own_base_and_leds_and_cameras_of_one_calibration_are_the_same(
    two: tuple[Session, Session],
) -> None:
    a, b = two
    one = combine({"a": a, "b": b})
    assert one.poses == tuple(f"a/{pose}" for pose in a.poses) + tuple(f"b/{pose}" for pose in b.poses)
    assert one.parts == ("a", "b")
    assert one.part.tolist() == [0] * 6 + [1] * 5
    assert one.led_names == ("a/led", "b/led")
    assert one.rig.names == a.rig.names
    table, of_a, of_b = one.find(Detections), a.find(Detections), b.find(Detections)
    assert np.array_equal(table.uv, np.concatenate([of_a.uv, of_b.uv]))
    assert np.array_equal(table.camera, np.concatenate([of_a.camera, of_b.camera]))
    assert np.array_equal(table.led, np.concatenate([of_a.led, of_b.led + 1]))
    assert np.array_equal(one.q, np.concatenate([a.q, b.q]))


def test_cameras_of_another_calibration_are_others_with_a_world_of_their_own(two: tuple[Session, Session]) -> None:
    a, b = known(two[0], 1), known(two[1], 2)
    one = combine({"a": a, "b": b})
    names = a.rig.names
    assert one.rig.names == tuple(f"{part}/{name}" for part in "ab" for name in names)
    assert one.attachments.worlds.tolist() == [0, 2]
    assert one.attachments.reference.tolist() == [0, 0, 2, 2]
    for k, of in enumerate((a, b)):
        np.testing.assert_array_equal(one.attachments.T_cam_frame[2 * k + 1], of.attachments.T_cam_frame[1])
    total = sum(_COUNT)
    blocks = one.rig.correlation
    np.testing.assert_array_equal(blocks[:total, :total], a.rig.correlation)
    np.testing.assert_array_equal(blocks[total:, total:], b.rig.correlation)
    assert not blocks[:total, total:].any()
    assert np.unique(one.find(Detections).camera[one.part[one.find(Detections).pose] == 1]).tolist() == [2, 3]


def test_what_one_calibration_is_wrong_by_is_counted_once(two: tuple[Session, Session]) -> None:
    one = combine({"a": known(two[0], 1), "b": known(two[1], 1)})
    assert len(one.rig.correlation) == sum(_COUNT)


def test_a_camera_of_unknown_place_keeps_only_its_lens(two: tuple[Session, Session]) -> None:
    a, b = (replace(of, rig=replace(of.rig, T_cam_world=(np.eye(4), None))) for of in two)
    one = combine({"a": a, "b": b})
    left, right = a.rig.names
    assert one.rig.names == (left, f"a/{right}", f"b/{right}")
    assert one.rig.lens == (0, 1, 1)
    assert one.attachments.worlds.tolist() == [0]
    chain = read_mechanism(a.urdf, [a.chain.tip_link, "forearm_link"], a.chain.base_link)
    mounts = (CameraMount(right, "forearm_link", np.eye(4), np.ones(6)),)
    one = combine({name: replace(of, chain=chain, mounts=mounts) for name, of in (("a", a), ("b", b))})
    assert one.attachments.reference.tolist() == [0, 1, 2]
    assert all(np.array_equal(T, np.eye(4)) for T in one.attachments.T_cam_frame)


def test_leds_may_be_on_different_links(two: tuple[Session, Session]) -> None:
    a, b = two
    chain = read_mechanism(b.urdf, [b.chain.tip_link, "forearm_link"], b.chain.base_link)
    b = replace(b, chain=chain, leds=(replace(b.leds[0], link="forearm_link"),))
    one = combine({"a": a, "b": b})
    assert [one.attachments.frames[frame] for frame in one.attachments.led] == [a.chain.tip_link, "forearm_link"]


def test_what_is_said_of_things_goes_with_them(two: tuple[Session, Session]) -> None:
    a, b = two
    left, right = a.rig.names
    a = replace(a, estimate=Estimate("dh", extrinsics={right: "refine"}))
    b = replace(
        b,
        leds=(*b.leds, Led("other")),
        led_distances=(LedDistance(("led", "other"), 0.1, 1e-3),),
        estimate=Estimate(intrinsics="free"),
        warnings=("odd",),
    )
    one = combine({"a": a, "b": b})
    assert one.led_distances == (LedDistance(("b/led", "b/other"), 0.1, 1e-3),)
    assert one.estimate == Estimate("dh", {left: "free", right: "free"}, {right: "refine"})
    assert one.warnings == ("b: odd",)


def test_what_is_known_of_all_is_said_once_and_the_rest_by_name(two: tuple[Session, Session]) -> None:
    about = ({"serial": "0042", "operator": "A"}, {"serial": "0042", "operator": "B", "site": "lab"})
    monday, tuesday = (replace(of, about=said) for of, said in zip(two, about, strict=True))
    assert combine({"monday": monday, "tuesday": tuesday}).about == {
        "serial": "0042", "monday/operator": "A", "tuesday/operator": "B", "tuesday/site": "lab",
    }  # fmt: skip


def test_a_tracker_and_cameras_are_two_worlds(two: tuple[Session, Session]) -> None:
    a, b = two
    pose = np.arange(len(b.poses))
    b = replace(b, measurements=(Points(pose, np.zeros(len(pose), int), np.ones((len(pose), 3)), np.array(1e-4)),))
    one = combine({"a": a, "b": b})
    assert {type(table) for table in one.measurements} == {Detections, Points}
    assert one.find(Points).pose.tolist() == (len(a.poses) + pose).tolist()


def test_logs_of_moving_arms_follow_each_other(simulated: Callable) -> None:
    settings = MotionSettings(frame_rate=1.0, joint_rate=20.0)
    parts = [set_in_motion(simulated("ur5", poses=8, seed=seed), settings).session for seed in (0, 1)]
    one = combine(dict(zip("ab", parts, strict=True)))
    offsets = np.array([0.02, -0.01])
    each = [of.motion.values(offsets) for of in parts]
    np.testing.assert_allclose(one.motion.values(offsets), np.concatenate(each), rtol=0.0, atol=1e-9)
    labels = [of.label(k) for of in parts for k in range(len(of.poses))]
    assert [one.label(k) for k in range(len(one.poses))] == labels
    assert np.all(one.motion.covered(len(labels), offsets))
    assert not set(one.motion.independent(one.q)[one.part == 0]) & set(one.motion.independent(one.q)[one.part == 1])


def test_sessions_that_contradict_each_other_are_refused(two: tuple[Session, Session], simulated: Callable) -> None:
    a, b = two
    chain = b.chain
    moved = chain.with_placements(chain.placements @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    moving = set_in_motion(simulated("ur5", poses=8), MotionSettings(frame_rate=1.0, joint_rate=20.0)).session
    on_wrist = read_mechanism(b.urdf, ["wrist_3_link"], chain.base_link)
    cases: list[tuple[Session, str]] = [
        (a, "'b' is 'a' once more"),
        (simulated("panda", poses=6).session, "'b' and 'a': the robots have different base links, 'panda_link0' and"),
        (replace(b, chain=on_wrist), "'b' and 'a': the robots have different tip links, 'wrist_3_link' and 'tool0'"),
        (replace(b, chain=moved), "joint 'shoulder_pan_joint' differs: these are two robots"),
        (moving, "a, b: the arm moved in some and rested in others. Calibrate each alone; `urdfcal compare`"),
        (replace(b, noise=Noise(joint=b.noise.joint)), "a, b: noise: pixel is said in others, not in 'b'. Say it in"),
        (replace(b, scale_sigma=0.01), "b: scale: sigma is 0.01, in 'a' not said. Say the same .*, with one unit"),
        (replace(b, tolerances=Tolerances(length=0.1)), "b: tolerances is Tolerances"),
        (replace(b, estimate=Estimate("full")), "b: estimate: geometry is full, in 'a' dh"),
    ]
    for other, message in cases:
        with pytest.raises(SessionError, match=message):
            combine({"a": replace(a, estimate=Estimate("dh")) if other is not a else a, "b": other})


def test_it_is_not_written_as_one(two: tuple[Session, Session], tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"it is several sessions in one\. Write each"):
        write_session(tmp_path / "out", combine(dict[str, Any](zip("ab", two, strict=True))))
    assert not list(tmp_path.iterdir())


def test_each_carries_its_own_payload_and_came_from_its_own_poses(two: tuple[Session, Session]) -> None:
    a, b = two
    heavy = replace(b, payload=Payload("tool0", 5.0, np.array([0.0, 0.0, 0.1])))
    one = combine({"a": a, "b": heavy})
    found = Compliance.of(one).features(Readings.of(one))
    each = [Compliance.of(of).features(Readings.of(of)) for of in (a, heavy)]
    np.testing.assert_array_equal(found, np.concatenate(each))
    assert np.abs(each[1] - Compliance.of(b).features(Readings.of(b))).max() > 1.0
    np.testing.assert_array_equal(one.came_from, np.concatenate([a.came_from, b.came_from]))
    alike = combine({"a": replace(a, payload=heavy.payload), "b": heavy})
    assert alike.payload is heavy.payload
    assert not alike.payloads


def test_torques_are_measured_in_all_or_in_none(two: tuple[Session, Session]) -> None:
    a, b = (replace(of, torques=np.full(of.q.shape, k + 1.0)) for k, of in enumerate(two))
    np.testing.assert_array_equal(combine({"a": a, "b": b}).torques, np.concatenate([a.torques, b.torques]))
    with pytest.raises(SessionError, match=r"b: there are no torques, as there are in the others\. Leave the key out"):
        combine({"a": a, "b": two[1]})
