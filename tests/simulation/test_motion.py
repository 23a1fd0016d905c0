"""A simulated arm in motion: smooth, within its limits, and known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.simulation import motion as simulated_motion
from urdfcal.simulation.motion import MotionSettings, _is_free, _tour, set_in_motion
from urdfcal.simulation.moving import JointPath
from urdfcal.simulation.planning import load_collision_checker

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.mark.no_cover
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
    checker, _ = load_collision_checker(still.truth, still.session)
    assert checker is None or all(checker.is_free(q) for q in moving.truth.q[::20])


def test_legs_are_ridden_at_full_speed_and_short_ones_no_more_steeply() -> None:
    lengths = np.array([0.01, 0.3, 0.6, 2.0])
    path = JointPath.through(np.concatenate([[0.0], np.cumsum(lengths)])[:, None] * [[1.0, -0.5]], 0.5)
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
    uv = moving.truth.pixels(moving.truth.q)[d.pose, d.camera, d.led]
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
    for name in ("speed", "frame_rate", "joint_rate"):
        for value in (0.0, -1.0, np.nan, np.inf):
            with pytest.raises(SessionError, match=f"{name} is {value}, not a positive number"):
                MotionSettings(**{name: value})
    with pytest.raises(SessionError, match=r"time offsets .* are not all numbers"):
        MotionSettings(time_offsets=(0.1, np.inf))
    with pytest.raises(SessionError, match="1 time offsets for 2 cameras"):
        set_in_motion(simulated("elbow3r", poses=5), MotionSettings(time_offsets=(0.1,)))


class Walls:
    """A checker of one joint that cannot be within 0.1 of some values."""

    def __init__(self, *values: float) -> None:
        self.values = np.array(values)

    def is_free(self, q: np.ndarray) -> bool:
        return bool((np.abs(self.values - q[0]) > 0.1).all())


def test_a_path_is_free_if_all_of_it_is() -> None:
    a, b = np.array([0.0]), np.array([1.0])
    assert _is_free(a, b, Walls())
    assert not _is_free(a, b, Walls(0.5))
    assert not _is_free(a, b, Walls(1.0))
    assert _is_free(a, b, None)


def test_a_tour_visits_what_it_can_reach_by_the_shortest_way() -> None:
    q = np.array([[0.0], [3.0], [1.0], [2.0], [9.0]])
    assert _tour(q, Walls(5.0)).ravel().tolist() in ([0.0, 1.0, 2.0, 3.0], [3.0, 2.0, 1.0, 0.0])
    assert len(_tour(q, None)) == 5


def test_a_tour_goes_back_the_way_it_came_where_there_is_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    # Three poses that have a free path to the middle one only.
    q = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [-2.0, 0.0]])
    monkeypatch.setattr(simulated_motion, "_is_free", lambda a, b, _: not (a.any() and b.any()))
    tour = _tour(q, None)
    assert {tuple(one) for one in tour} == {tuple(one) for one in q}
    assert not (tour[:-1].any(axis=1) & tour[1:].any(axis=1)).any()
    assert len(tour) == 5  # a leaf, the middle, a leaf, the middle, a leaf


def test_poses_without_a_path_are_refused(simulated: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulated_motion, "_is_free", lambda *_: False)
    with pytest.raises(SessionError, match=r"between no two poses there is a straight path.*another seed"):
        set_in_motion(simulated("elbow3r", poses=5), MotionSettings())


def test_a_part_of_the_detections_of_a_moving_arm_are_outliers(simulated: Callable) -> None:
    still = simulated("elbow3r", poses=4, outliers=0.1)
    moving = set_in_motion(still, MotionSettings(frame_rate=3.0))
    d, rows = moving.session.find(Detections), moving.truth.outliers
    assert len(rows) == round(0.1 * len(d))
    error = np.linalg.norm(d.uv - moving.truth.pixels(moving.truth.q)[d.pose, d.camera, d.led], axis=1)
    assert error[rows].min() > 4.0
    assert np.delete(error, rows).max() < 1.0
