"""A moving arm: the cameras' clocks are found with it, and it calibrates as well as one that stands still."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from urdfcal.estimation.time_offset import start_state

from urdfcal.errors import CalibrationError
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.linearize import Tangent, predict
from urdfcal.estimation.model_spec import Freedoms
from urdfcal.estimation.observations import observe
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.validation import _folds
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import FittedCalibration, calibrate
from urdfcal.robot.chain import Chain
from urdfcal.robot.dh import DHTable
from urdfcal.session.model import Estimate
from urdfcal.session.trajectory import JointLog
from urdfcal.simulation.motion import Motion, set_in_motion
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated

OFFSETS = (0.02, -0.007)
ARM_ALONE = Estimate("dh", "fixed", "fixed")
FIXED = Freedoms("dh", ("fixed",) * 2, ("fixed",) * 2)


@cache
def filmed(
    rig: str, poses: int, rate: float, offsets: tuple[float, ...] = OFFSETS, outliers: float = 0.0, seed: int = 1
) -> Simulated:
    still = simulate(read_rig(find_rig(rig)), poses=poses, seed=seed, pixel=0.1, outliers=outliers)
    return set_in_motion(still, Motion(frame_rate=rate, time_offsets=offsets))


def at_rest(moving: Simulated) -> Session:
    """The same frames, the arm at rest in each of them and read by the same encoders."""
    session = moving.session
    readings = session.chain.readings(moving.truth.q)
    readings = readings + session.noise.joint * np.random.default_rng(9).standard_normal(readings.shape)
    return replace(session, q=session.chain.joint_values(readings), trajectory=None)


def tip_error(calibration: FittedCalibration, simulated: Simulated) -> float:
    drawn = calibration.chain
    q = drawn.random_values(300, np.random.default_rng(0))
    built, true = (
        Chain(drawn.name, drawn.base_link, drawn.tip_link, drawn.joints, placements, drawn.T_last_tip)
        for placements in (calibration.placements, simulated.truth.placements)
    )
    return float(np.sqrt(np.mean(compare(built, true, q).position ** 2)))


@pytest.mark.parametrize("rig", ["elbow3r", "panda", "stanford"])
def test_the_derivative_by_the_time_offsets_agrees_with_finite_differences(rig: str, true_state: Callable) -> None:
    data = filmed(rig, 6, 1.0)
    session, table = data.session, DHTable.from_chain(data.session.chain)
    (block,) = observe(session)
    state = replace(true_state(data), time_offsets=np.array(OFFSETS))
    parameters = choose_parameters(session, table, state, Freedoms("dh", ("free",) * 2, ("fixed", "free")))
    assert parameters.names[-2:] == ("cam0.time_offset", "cam1.time_offset")
    assert parameters.clock(1).stop == parameters.size
    J = Tangent.at(table, block, state, parameters).linearise(slice(None)).J
    for c in range(2):
        step = np.zeros(parameters.count)
        step[parameters.clock(c)] = 1e-5
        before, after = (predict(table, block, parameters.move(state, s * step)) for s in (-1, 1))
        numeric = (after - before) / 2e-5
        assert np.abs(J[..., parameters.clock(c).start] - numeric).max() < 1e-5 * np.abs(numeric).max()
        assert not np.any(J[..., parameters.clock(c).start][block.camera != c])


def test_priors_of_the_time_offsets_have_their_derivatives(true_state: Callable) -> None:
    data = filmed("elbow3r", 6, 1.0)
    state = replace(true_state(data), time_offsets=np.array([0.3, -0.2]))
    parameters = choose_parameters(data.session, DHTable.from_chain(data.session.chain), state, FIXED)
    r, J = parameters.prior_residuals(state)
    for k in range(parameters.count):
        step = 1e-6 * np.eye(parameters.count)[k]
        before, after = (parameters.prior_residuals(parameters.move(state, s * step))[0] for s in (-1, 1))
        np.testing.assert_allclose(J[:, k], (after - before) / 2e-6, atol=1e-6)
    assert r[-2:] == pytest.approx([0.3, -0.2])


def test_a_moving_arm_calibrates_as_well_as_a_still_one_and_the_clocks_are_found() -> None:
    # ur5: its encoders' noise, drawn anew for the arm at rest, is small beside the pixels', which are the same. Clocks
    # two or three of their standard deviations off make a single arm half as bad again: so rms over three.
    errors = []
    for seed in range(3):
        moving = filmed("ur5", 30, 3.0, seed=seed)
        found, still = (
            calibrate(replace(session, estimate=ARM_ALONE), force=True) for session in (moving.session, at_rest(moving))
        )
        assert np.abs(found.estimate.time_offsets - OFFSETS).max() < 2e-4
        errors.append((tip_error(found, moving), tip_error(still, moving)))
        clocks = found.to_dict()["cameras"]
        for c, offset in zip(("cam0", "cam1"), OFFSETS, strict=True):
            value, sigma = clocks[c]["time_offset"]["value"], clocks[c]["time_offset"]["sigma"]
            assert abs(value - offset) < 4.0 * sigma
            assert sigma < 1e-4
        np.testing.assert_allclose(found.session.q, moving.truth.q, atol=6.0 * moving.session.noise.joint)
    moved, rested = np.sqrt(np.mean(np.square(errors), axis=0))
    assert moved < 1.3 * rested


def test_without_the_offsets_the_arm_would_be_wrong() -> None:
    moving = filmed("elbow3r", 12, 15.0)
    found, fixed = (
        calibrate(replace(moving.session, estimate=replace(ARM_ALONE, time_offset=word)), force=True)
        for word in (None, "fixed")
    )
    assert not fixed.estimate.time_offsets.any()
    assert fixed.to_dict()["cameras"]["cam0"]["time_offset"] == {"value": 0.0, "sigma": None}
    assert tip_error(fixed, moving) > 5.0 * tip_error(found, moving)


@pytest.mark.parametrize("offsets", [(0.73, -0.9), (0.0, 0.45)])
def test_clocks_that_are_off_by_a_second_are_found_by_trying(offsets: tuple[float, float]) -> None:
    moving = filmed("ur5", 12, 4.0, offsets)
    start = start_state(moving.session, DHTable.from_chain(moving.session.chain), np.zeros((6, 5)))
    assert np.abs(start.time_offsets - offsets).max() <= 0.1
    found = calibrate(replace(moving.session, estimate=ARM_ALONE), force=True)
    assert np.abs(found.estimate.time_offsets - offsets).max() < 5e-4


def test_frames_that_the_log_does_not_reach_once_the_clocks_are_set_are_left_out() -> None:
    moving = filmed("ur5", 12, 4.0, (0.93, -0.9))
    trajectory = moving.session.trajectory
    inner = (trajectory.log.time > 5.0) & (trajectory.log.time < trajectory.log.time[-1] - 5.0)
    log = JointLog(trajectory.log.time[inner], trajectory.log.values[inner])
    # As a table of frames is read: by what the clocks say themselves.
    read = replace(moving.session, trajectory=replace(trajectory, log=log)).at(
        np.flatnonzero(log.covers(trajectory.time))
    )
    true = read.trajectory.robot_time(np.array([0.93, -0.9]))
    assert np.count_nonzero((true < log.time[0]) | (true > log.time[-1])) > 4
    found = calibrate(replace(read, estimate=ARM_ALONE), force=True)
    assert np.abs(found.estimate.time_offsets - (0.93, -0.9)).max() < 5e-4
    times = found.session.trajectory.robot_time(found.estimate.time_offsets)
    assert log.time[0] < times.min() < log.time[0] + 0.5
    assert log.time[-1] - 0.5 < times.max() < log.time[-1]
    assert found.outliers() == []
    assert "frames have no joint readings at their time once the cameras' clocks are set" in found.warnings[-1]
    assert moving.session.recorded(np.array([0.93, -0.9])) is moving.session


def test_outliers_are_found_in_motion_as_well() -> None:
    moving = filmed("elbow3r", 12, 8.0, OFFSETS, 0.1)
    found = calibrate(replace(moving.session, estimate=ARM_ALONE), force=True)
    assert np.abs(found.estimate.time_offsets - OFFSETS).max() < 3e-4
    assert len(found.outliers()) == pytest.approx(len(moving.truth.outliers), rel=0.05)


def test_an_arm_that_stands_in_every_frame_tells_no_clock_and_that_is_said(true_state: Callable) -> None:
    moving = filmed("elbow3r", 6, 1.0)
    log = moving.session.trajectory.log
    # The places of a still session, one after the other, each held while a camera looks.
    q = np.repeat(log.values[:: len(log.values) // 40], 400, axis=0)
    time = 0.01 * np.arange(len(q))
    trajectory = replace(
        moving.session.trajectory,
        log=JointLog(time, q),
        time=np.resize(2.0 + 4.0 * np.arange(40), len(moving.session.poses)),
    )
    session = replace(moving.session, trajectory=trajectory, q=trajectory.values(np.zeros(2)))
    table, state = DHTable.from_chain(session.chain), replace(true_state(moving), time_offsets=np.zeros(2))
    found = identify(table, observe(session), state, choose_parameters(session, table, state, FIXED))
    told = [text for text in found.lost if "time_offset" in text]
    assert len(told) == 2
    assert all("does not move" in text for text in told)
    assert not found.parameters.active[found.parameters.clock(0)].any()


def test_folds_of_a_moving_arm_are_stretches_of_time() -> None:
    (block,) = observe(filmed("elbow3r", 6, 4.0).session)
    (fold,) = _folds([block], 5, seed=0)
    time = block.trajectory.time
    assert np.array_equal(np.bincount(fold) // 10, np.full(5, len(time) // 50)) or np.ptp(np.bincount(fold)) <= 1
    assert np.all(np.diff(fold[np.argsort(time)]) >= 0)


def test_frames_are_not_triangulated() -> None:
    with pytest.raises(CalibrationError, match="by one camera"):
        calibrate(filmed("elbow3r", 6, 4.0).session, method="points")
