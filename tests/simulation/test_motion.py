"""A simulated arm in motion: smooth, within its limits, and known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.simulation.collision import load_collision_checker
from urdfcal.simulation.motion import MotionSettings, _Path, set_in_motion

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.mark.parametrize("rig", ["elbow3r", "ur5", "stanford", "so101"])
def test_the_arm_moves_smoothly_within_its_limits_and_clear_of_itself(rig: str, simulated: Callable) -> None:
    still = simulated(rig, poses=12)
    moving = set_in_motion(still, MotionSettings(speed=0.5, joint_rate=100.0))
    log = moving.session.motion.log
    noise = 6.0 * still.session.noise.joint
    speed = np.abs(np.diff(log.values, axis=0)).max() / 0.01
    assert 0.45 < speed < 0.5 + 2.0 * noise / 0.01
    for joint, values in zip(still.session.chain.joints, log.values.T, strict=True):
        assert values.min() > joint.lower - noise
        assert values.max() < joint.upper + noise
    checker, _ = load_collision_checker(still.scene, still.session)
    assert checker is None or all(checker.is_free(q) for q in moving.truth.q[::20])


def test_legs_are_ridden_at_full_speed_and_short_ones_no_more_steeply() -> None:
    lengths = np.array([0.01, 0.3, 0.6, 2.0])
    path = _Path.through(np.concatenate([[0.0], np.cumsum(lengths)])[:, None] * [[1.0, -0.5]], 0.5)
    step = 1e-3
    values = path.at(np.arange(0.0, path.end + 1.0, step))
    velocity = np.diff(values, axis=0) / step
    acceleration = np.diff(velocity, axis=0) / step
    assert np.abs(velocity).max() == pytest.approx(0.5)
    assert np.abs(acceleration).max() == pytest.approx(0.75, rel=1e-3)
    assert np.abs(np.diff(acceleration, axis=0)).max() < 0.75 * 6.0 * step / np.sqrt(0.02)  # no jumps, on any leg
    np.testing.assert_allclose(path.at(path.times), path.poses, atol=1e-12)
    assert np.diff(path.times)[2:] == pytest.approx(lengths[2:] / 0.5 + 1.0)


def test_frames_show_the_true_arm_at_the_robots_time(simulated: Callable) -> None:
    still = simulated("elbow3r", poses=8, pixel=1e-9)
    moving = set_in_motion(still, MotionSettings(frame_rate=5.0, time_offsets=(0.4, -0.3)))
    session, d = moving.session, moving.session.find(Detections)
    uv = moving.scene.pixels(moving.truth.q)[d.pose, d.camera, d.led]
    np.testing.assert_allclose(d.uv, uv, atol=1e-6)
    trajectory = session.motion
    np.testing.assert_allclose(trajectory.values(np.array([0.4, -0.3])), moving.truth.q, atol=6e-4)
    assert np.diff(trajectory.time[trajectory.camera == 0]) == pytest.approx(0.2)
    assert moving.truth.time_offsets.tolist() == [0.4, -0.3]


def test_the_same_seed_moves_the_same_way(simulated: Callable) -> None:
    a, b = (set_in_motion(simulated("elbow3r", poses=5), MotionSettings(frame_rate=3.0)) for _ in range(2))
    assert np.array_equal(a.session.find(Detections).uv, b.session.find(Detections).uv)
    assert np.array_equal(a.truth.time_offsets, b.truth.time_offsets)
    assert np.abs(a.truth.time_offsets).max() <= 0.03
    assert a.truth.time_offsets.all()


def test_motions_that_are_none_are_refused(simulated: Callable) -> None:
    for arguments in ({"speed": 0.0}, {"frame_rate": -1.0}, {"joint_rate": np.nan}, {"time_offsets": (np.inf,)}):
        with pytest.raises(SessionError):
            MotionSettings(**arguments)
    with pytest.raises(SessionError, match="1 time offsets for 2 cameras"):
        set_in_motion(simulated("elbow3r", poses=5), MotionSettings(time_offsets=(0.1,)))
