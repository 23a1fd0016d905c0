from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import repeated, with_detections
from urdfcal.errors import RobotError, SessionError
from urdfcal.estimation.acceptance import Acceptance, _numbers, _taken_away, accept
from urdfcal.estimation.evaluation import explain
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.validation import rms_interval
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.tree_dh import rows_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated


def found(low: float, high: float, outliers: int = 0, limit: float = 1e-3) -> Acceptance:
    return Acceptance(0.5 * (low + high), (low, high), 12, 24, outliers, limit)


@pytest.mark.parametrize(
    ("one", "within"),
    [
        (found(5e-4, 9e-4), True),
        (found(5e-4, 1e-3), True),
        (found(5e-4, 1.1e-3), None),
        (found(1e-3, 1.2e-3), None),
        (found(1.1e-3, 1.2e-3), False),
        (found(5e-4, 9e-4, outliers=8), True),
        (found(5e-4, 9e-4, outliers=9), None),
    ],
)
def test_the_interval_decides_unless_too_much_was_left_out(one: Acceptance, within: bool | None) -> None:
    assert one.within is within


def true_arm(data: Simulated) -> object:
    return replace(data.session.chain, placements=data.truth.placements)


def pointed(data: Simulated, sigma: float = 1e-4) -> Session:
    """The session, measured by a tracker."""
    session, rng = data.session, np.random.default_rng(3)
    T = tip_poses(true_arm(data), data.truth.q)
    xyz = T[:, :3, :3] @ data.truth.leds[0] + T[:, :3, 3]
    xyz = xyz + rng.normal(0.0, sigma, xyz.shape)
    count = len(xyz)
    points = Points(np.arange(count), np.zeros(count, int), xyz, np.array(sigma))
    return replace(session, measurements=(points,), leds=session.leds[:1])


def test_few_poses_tell_the_rms_error_of_many(simulated: Callable) -> None:
    """Base, LED and the second camera take 15 numbers away: without that the error would be 0.6 times as large."""
    data = simulated("ur5", poses=60)
    session = data.session
    many = accept(session.chain, session, 1e-3)
    ratios = []
    for first in range(0, 60, 10):
        few = accept(session.chain, session.at(np.arange(first, first + 10)), 1e-3)
        ratios.append(few.rms / many.rms)
        assert few.configurations == 10
        assert few.interval[0] < few.rms < few.interval[1]
        assert few.interval[1] / few.interval[0] > 1.5 * many.interval[1] / many.interval[0]
    assert 0.85 < np.mean(ratios) < 1.2


def test_points_are_judged_by_their_distance(simulated: Callable) -> None:
    data = simulated("ur5", poses=60)
    session = pointed(data)
    for poses in (np.arange(60), np.arange(0, 60, 5)):
        judged = accept(true_arm(data), session.at(poses), 1e-3)
        noise = np.sqrt(3.0) * 1e-4
        assert judged.interval[0] < noise < judged.interval[1]
        assert judged.rms == pytest.approx(noise, rel=0.4)
        assert judged.within
    assert accept(session.chain, session, 1e-3).rms > 5.0 * noise


def test_the_interval_is_the_bootstraps_widened(simulated: Callable) -> None:
    session = simulated("ur5", poses=30).session
    explained = explain(session.chain, session)
    problem, fit = explained.problem, explained.fit
    (observed,) = problem.observations
    distance = np.linalg.norm(problem.residual(observed, fit.state), axis=-1)
    distance = distance * problem.metres_per_unit(observed, fit.state)
    unit = session.motion.independent(session.q)
    ends = np.array(rms_interval(problem.observations, fit.kept, [distance], unit, 0))
    rms = np.sqrt(np.mean(distance[fit.kept[0]] ** 2))
    scale, width = _taken_away(90, 15)
    judged = accept(session.chain, session, 1e-3)
    assert judged.outliers == 0
    assert judged.rms == pytest.approx(scale * rms)
    np.testing.assert_allclose(np.log(np.array(judged.interval) / judged.rms), width * np.log(ends / rms))


def test_in_pixels_a_common_factor_of_all_lengths_is_not_seen(simulated: Callable) -> None:
    """What METHOD 13 warns of; a tracker's points have it."""
    data = simulated("ur5", poses=60)
    placements = np.array(data.truth.placements)
    placements[:, :3, 3] *= 1.01
    longer = replace(data.session.chain, placements=placements)
    for session, seen in ((data.session, False), (pointed(data), True)):
        right, wrong = (accept(arm, session, 1e-3).rms for arm in (true_arm(data), longer))
        assert (wrong > 3.0 * right) is seen
        assert (wrong < 1.05 * right) is not seen


def test_repeats_of_a_configuration_are_no_further_ones(simulated: Callable) -> None:
    data = simulated("ur5", poses=30)
    once = accept(data.session.chain, data.session.at(np.arange(10)), 1e-3)
    five_times = accept(data.session.chain, repeated(data, 0.0), 1e-3)
    assert five_times.configurations == once.configurations == 10
    assert five_times.measurements == 5 * once.measurements
    assert five_times.rms == pytest.approx(once.rms, rel=0.1)
    np.testing.assert_allclose(five_times.interval, once.interval, rtol=0.15)


def test_what_is_taken_away_is_made_up_for() -> None:
    scale, width = _taken_away(36, 27)
    assert scale == 2.0
    assert width == pytest.approx(2.0 * 3.182 / 1.960, rel=1e-3)
    assert _taken_away(3_000_000, 9) == pytest.approx((1.0, 1.0), abs=1e-4)


def test_an_led_has_three_errors_in_a_configuration_of_which_one_camera_sees_two(simulated: Callable) -> None:
    data = simulated("ur5", poses=30)
    detections = data.session.find(Detections)
    single = replace(data.session, measurements=(detections.rows(detections.camera == 0),))
    assert np.unique(detections.camera).tolist() == [0, 1]
    for session, numbers in ((single, 60), (data.session, 90), (pointed(data), 90), (repeated(data, 0.0), 30)):
        problem = Problem.of(session, rows_of(session.chain))
        unit = session.motion.independent(session.q)
        assert _numbers(problem.observations, [of.valid for of in problem.observations], unit) == numbers


def test_too_few_configurations_are_refused_however_often_they_are_measured(simulated: Callable) -> None:
    session = repeated(simulated("ur5", poses=30), 0.0)
    of_ten = np.arange(len(session.poses)) % 10
    with pytest.raises(SessionError, match=r"^15 measured numbers .* beside 15 unknowns") as refused:
        accept(session.chain, session.at(np.flatnonzero(of_ten < 5)), 1e-3)
    assert "Measure more poses" in refused.value.remedy
    assert accept(session.chain, session.at(np.flatnonzero(of_ten < 6)), 1e-3).configurations == 6


def test_outliers_do_not_count_and_are_counted(simulated: Callable) -> None:
    data = simulated("ur5", poses=30)
    detections = data.session.find(Detections)
    uv = np.array(detections.uv)
    uv[[4, 21]] += 150.0
    before = accept(true_arm(data), data.session, 1e-3)
    spoilt = accept(true_arm(data), with_detections(data.session, uv=uv), 1e-3)
    assert (before.outliers, spoilt.outliers) == (0, 2)
    assert spoilt.measurements == before.measurements - 2
    assert spoilt.rms == pytest.approx(before.rms, rel=0.1)


def test_another_robots_session_is_refused(simulated: Callable) -> None:
    with pytest.raises(RobotError, match="the arm's joints are joint_1"):
        accept(simulated("elbow3r").session.chain, simulated("ur5").session, 1e-3)
