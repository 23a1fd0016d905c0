"""Joint values between readings: exact where they can be, and none where nothing was recorded."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from urdfcal.errors import SessionError
from urdfcal.session.trajectory import LONGEST_GAP, MARGIN, JointLog, Trajectory

TIME = np.linspace(3.0, 5.0, 41)


@settings(deadline=None)  # the first call imports SciPy
@given(st.lists(st.floats(-2.0, 2.0), min_size=4, max_size=4), st.floats(3.0, 5.0))
def test_a_cubic_motion_is_met_exactly_with_its_velocity(coefficients: list[float], time: float) -> None:
    motion = np.polynomial.Polynomial(coefficients)
    log = JointLog(TIME, motion(TIME - 4.0)[:, None])
    at = np.array([time])
    assert log.at(at)[0, 0] == pytest.approx(motion(time - 4.0), abs=1e-11)
    assert log.velocities(at)[0, 0] == pytest.approx(motion.deriv()(time - 4.0), abs=1e-9)


def test_the_curve_goes_through_the_readings_and_has_the_velocity_it_says() -> None:
    rng = np.random.default_rng(0)
    log = JointLog(np.cumsum(rng.uniform(0.004, 0.012, 300)), rng.normal(0.0, 1.0, (300, 3)).cumsum(axis=0))
    np.testing.assert_allclose(log.at(log.time), log.values, atol=1e-12)
    at = rng.uniform(log.time[0] + 0.1, log.time[-1] - 0.1, 200)
    numeric = (log.at(at + 1e-6) - log.at(at - 1e-6)) / 2e-6
    np.testing.assert_allclose(log.velocities(at), numeric, rtol=1e-6, atol=1e-3)


def test_readings_with_noise_are_followed_no_worse_than_they_were_read() -> None:
    rng, time = np.random.default_rng(1), np.arange(0.0, 40.0, 1.0 / 125.0)

    def swing(t: np.ndarray) -> np.ndarray:
        return 0.32 * np.sin(np.pi / 2.0 * t)

    at = rng.uniform(1.0, 39.0, 4000)
    exact, noisy = (JointLog(time, (swing(time) + s * rng.standard_normal(len(time)))[:, None]) for s in (0.0, 2e-5))
    assert np.abs(exact.at(at)[:, 0] - swing(at)).max() < 1e-9
    assert np.std(noisy.at(at)[:, 0] - swing(at)) < 2e-5


def test_beyond_its_ends_the_arm_stands() -> None:
    log = JointLog(TIME, np.sin(TIME)[:, None])
    outside = np.array([0.0, 9.0])
    np.testing.assert_allclose(log.at(outside)[:, 0], np.sin([3.0, 5.0]))
    assert not log.velocities(outside).any()


def test_ends_and_gaps_are_not_covered_nor_what_is_beside_them() -> None:
    time = np.concatenate([np.arange(0.0, 1.0, 0.01), np.arange(1.0 + 2.0 * LONGEST_GAP, 3.0, 0.01)])
    log = JointLog(time, np.zeros((len(time), 1)))
    at = np.array([-0.1, 0.5 * MARGIN, 0.5, 0.99 - 0.5 * MARGIN, 1.1, 1.3 + 0.5 * MARGIN, 2.0, time[-1] - 0.5 * MARGIN])
    assert log.covers(at).tolist() == [False, False, True, False, False, False, True, False]


def test_frames_are_asked_for_by_their_cameras_clock() -> None:
    log = JointLog(TIME, np.sin(TIME)[:, None])
    trajectory = Trajectory(
        log, (("a", "b"), ("a",)), np.array([0, 0, 1]), np.array([0, 1, 0]), np.array([3.5, 4, 3.6])
    )
    offsets = np.array([0.02, -0.007])
    np.testing.assert_allclose(trajectory.values(offsets)[:, 0], np.sin([3.52, 4.02, 3.593]), atol=1e-7)
    assert [trajectory.label(k) for k in range(3)] == ["a", "b", "a"]
    assert trajectory.at(np.array([2])).values(offsets)[0, 0] == pytest.approx(np.sin(3.593), abs=1e-7)


def test_two_readings_are_a_log() -> None:
    assert JointLog(np.array([0.0, 1.0]), np.array([[0.0], [2.0]])).at(np.array([0.5]))[0, 0] == pytest.approx(1.0)
    with pytest.raises(SessionError, match="a log of joint values has times"):
        JointLog(np.zeros(1), np.zeros((1, 1)))


def test_frames_have_a_camera_a_row_and_a_time_each() -> None:
    log = JointLog(TIME, np.sin(TIME)[:, None])
    with pytest.raises(SessionError, match="differ in number"):
        Trajectory(log, (("a", "b"),), np.array([0, 0]), np.array([0, 1]), np.array([3.5]))


@pytest.mark.parametrize("time", [[0.0, 0.1, 0.1], [0.0, 0.2, 0.1], [0.0, np.nan, 0.2], [0.0, 0.1]])
def test_a_log_that_does_not_run_forward_is_refused(time: list[float]) -> None:
    with pytest.raises(SessionError):
        JointLog(np.array(time), np.zeros((3, 1)))


def test_readings_that_no_joint_can_have_are_refused() -> None:
    time, values = np.array([0.0, 1e-300, 1.0]), np.array([[0.0], [0.1], [0.2]])
    with pytest.raises(SessionError, match=r"a joint moves at .* between two readings"):
        JointLog(time, values)


@pytest.mark.parametrize("count", [2, 5, 200])
def test_what_follows_a_little_later_is_the_motion_and_not_the_readings_noise(count: int) -> None:
    rng, time = np.random.default_rng(0), np.linspace(0.0, 1.6, count)
    noise = 0.0 if count < 200 else 4e-4
    log = JointLog(time, (0.5 * time + noise * rng.standard_normal(count))[:, None])
    at, late = rng.uniform(0.2, 1.4, 300), rng.uniform(-0.015, 0.015, 300)
    values, by_time, by_lateness = log.later(at, late)
    np.testing.assert_allclose((values - log.at(at))[:, 0], 0.5 * late, atol=1e-12 + 0.4 * noise)
    assert np.std(by_lateness - 0.5) <= 30.0 * noise + 1e-12
    for derivative, shift in ((by_time, (1e-6, 0.0)), (by_lateness, (0.0, 1e-6))):
        before, after = (log.later(at + s * shift[0], late + s * shift[1])[0] for s in (-1.0, 1.0))
        np.testing.assert_allclose(derivative, (after - before) / 2e-6, atol=1e-5)
