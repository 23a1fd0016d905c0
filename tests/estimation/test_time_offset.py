"""A moving arm: the cameras' time offsets are found with it, and it calibrates as well as one at rest."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.problems import Estimated
from tests.worlds import RIGID
from urdfcal.arrays import rms
from urdfcal.errors import CalibrationError
from urdfcal.estimation.evaluation import compare, explain
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.joint_models.found import FoundJointModels
from urdfcal.estimation.joint_models.time_offset import TIME_OFFSETS
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.time_offset_start import start_state
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import DHTable
from urdfcal.robot.gravity import STANDARD_GRAVITY
from urdfcal.session.knowledge import Estimate
from urdfcal.session.trajectory import AT_REST, JointLog
from urdfcal.simulation.motion import MotionSettings, set_in_motion
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated

OFFSETS = (0.02, -0.007)
ARM_ALONE = Estimate("dh", "fixed", "fixed")
FIXED = ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2)


@cache
def filmed(
    rig: str, poses: int, rate: float, offsets: tuple[float, ...] = OFFSETS, outliers: float = 0.0, seed: int = 1
) -> Simulated:
    still = simulate(read_rig(find_rig(rig)), poses=poses, seed=seed, pixel=0.1, outliers=outliers)
    return set_in_motion(still, MotionSettings(frame_rate=rate, time_offsets=offsets))


def at_rest(moving: Simulated) -> Session:
    """The same frames, the arm at rest in each of them and read by the same encoders."""
    session = moving.session
    readings = session.chain.readings(moving.truth.q)
    readings = readings + session.noise.joint * np.random.default_rng(9).standard_normal(readings.shape)
    return replace(session, q=session.chain.joint_values(readings), motion=AT_REST)


def tip_error(found: FittedCalibration | Estimated, simulated: Simulated) -> float:
    nominal = found.session.chain
    q = nominal.random_values(300, np.random.default_rng(0))
    calibrated, true = (
        replace(nominal, placements=placements) for placements in (found.placements, simulated.truth.placements)
    )
    return float(np.sqrt(np.mean(compare(calibrated, true, q).position ** 2)))


def problem_of(session: Session) -> Problem:
    return Problem.of(session, DHTable.from_chain(session.chain))


@pytest.mark.parametrize("rig", ["elbow3r", "panda", "stanford"])
def test_the_derivative_by_the_time_offsets_agrees_with_finite_differences(rig: str, true_state: Callable) -> None:
    data = filmed(rig, 6, 1.0)
    session = data.session
    problem, state = problem_of(session), true_state(data, time_offset=np.array(OFFSETS))
    (observed,) = problem.observations
    parameters = choose_parameters(session, problem, state, ModelSpec("dh", ("free",) * 2, ("fixed", "free")))
    assert parameters.names[parameters.columns(TIME_OFFSETS)] == ("cam0.time_offset", "cam1.time_offset")
    columns, active = parameters.active_columns(TIME_OFFSETS)
    assert active.all()
    J = Tangent.at(problem, observed, state, parameters).linearise(slice(None)).J
    for c, column in enumerate(range(columns.start, columns.stop)):
        step = np.zeros(parameters.count)
        step[column] = 1e-5
        before, after = (problem.predict(observed, parameters.retract(state, s * step)) for s in (-1, 1))
        numeric = (after - before) / 2e-5
        assert np.abs(J[..., column] - numeric).max() < 1e-5 * np.abs(numeric).max()
        assert not np.any(J[..., column][observed.index["camera"] != c])


def test_priors_of_the_time_offsets_have_their_derivatives(true_state: Callable) -> None:
    data = filmed("elbow3r", 6, 1.0)
    state = true_state(data, time_offset=np.array([0.3, -0.2]))
    parameters = choose_parameters(data.session, problem_of(data.session), state, FIXED)
    r, J = parameters.prior_residuals(state)
    for k in range(parameters.count):
        step = 1e-6 * np.eye(parameters.count)[k]
        before, after = (parameters.prior_residuals(parameters.retract(state, s * step))[0] for s in (-1, 1))
        np.testing.assert_allclose(J[:, k], (after - before) / 2e-6, atol=1e-6)
    with_prior = np.flatnonzero(np.isfinite(parameters.prior) & parameters.active)
    own = np.isin(with_prior, np.arange(parameters.size)[parameters.columns(TIME_OFFSETS)])
    assert r[: len(with_prior)][own] == pytest.approx([0.3, -0.2])


@pytest.mark.no_cover
def test_a_moving_arm_calibrates_as_well_as_a_still_one_and_the_time_offsets_are_found() -> None:
    # ur5: its encoders' noise, drawn anew for the arm at rest, is small beside the pixels', which are the same. Time
    # offsets two or three of their standard deviations off make a single arm half as bad again: so rms over three.
    errors = []
    for seed in range(3):
        moving = filmed("ur5", 15, 1.0, seed=seed)
        found, still = (Estimated.of(session) for session in (moving.session, at_rest(moving)))
        off, sigma = np.abs(found.fit.state[TIME_OFFSETS] - OFFSETS), found.sigmas_of(TIME_OFFSETS)
        assert off.max() < 2e-4
        assert np.all(off < 4.0 * sigma)
        assert sigma.max() < 1e-4
        errors.append((tip_error(found, moving), tip_error(still, moving)))
        np.testing.assert_allclose(found.session.q, moving.truth.q, atol=6.0 * moving.session.noise.joint)
    moved, rested = np.sqrt(np.mean(np.square(errors), axis=0))
    assert moved < 1.3 * rested


@pytest.mark.no_cover
@pytest.mark.usefixtures("no_trials")
def test_without_the_offsets_the_arm_would_be_wrong() -> None:
    moving = filmed("elbow3r", 12, 5.0)
    rigid = replace(moving.session, joint_models=RIGID)
    found, fixed = (
        calibrate(replace(rigid, estimate=replace(ARM_ALONE, time_offset=word)), force=True) for word in (None, "fixed")
    )
    assert not fixed.estimate.time_offsets.any()
    assert fixed.to_dict()["cameras"]["cam0"]["time_offset"] == {"value": 0.0, "sigma": None}
    assert tip_error(fixed, moving) > 5.0 * tip_error(found, moving)


@pytest.mark.parametrize("offsets", [(0.73, -0.9), (0.0, 0.45)])
def test_time_offsets_of_a_second_are_found_by_trying(offsets: tuple[float, float]) -> None:
    moving = filmed("ur5", 12, 2.0, offsets)
    start = start_state(moving.session, DHTable.from_chain(moving.session.chain), np.zeros((6, 5)))
    assert np.abs(start[TIME_OFFSETS] - offsets).max() <= 0.1
    assert np.abs(Estimated.of(moving.session).fit.state[TIME_OFFSETS] - offsets).max() < 5e-4


@pytest.mark.no_cover
def test_frames_that_the_log_does_not_reach_once_the_time_offsets_are_known_are_left_out() -> None:
    moving = filmed("ur5", 12, 4.0, (0.93, -0.9))
    trajectory = moving.session.motion
    inner = (trajectory.log.time > 5.0) & (trajectory.log.time < trajectory.log.time[-1] - 5.0)
    log = JointLog(trajectory.log.time[inner], trajectory.log.values[inner])
    # As a table of frames is read: by what the clocks say themselves.
    read = replace(moving.session, motion=replace(trajectory, log=log)).at(np.flatnonzero(log.covers(trajectory.time)))
    true = read.motion.robot_time(np.array([0.93, -0.9]))
    assert np.count_nonzero((true < log.time[0]) | (true > log.time[-1])) > 4
    found = calibrate(replace(read, estimate=ARM_ALONE, joint_models=RIGID), force=True)
    assert np.abs(found.estimate.time_offsets - (0.93, -0.9)).max() < 5e-4
    times = found.session.motion.robot_time(found.estimate.time_offsets)
    assert log.time[0] < times.min() < log.time[0] + 0.5
    assert log.time[-1] - 0.5 < times.max() < log.time[-1]
    assert found.document.outliers == []
    assert "frames have no joint readings at their time once the cameras' time offsets are known" in found.warnings[-1]
    assert moving.session.recorded(np.array([0.93, -0.9])) is moving.session


@pytest.mark.no_cover
def test_outliers_are_found_in_motion_as_well() -> None:
    moving = filmed("elbow3r", 12, 4.0, OFFSETS, 0.1)
    found = calibrate(replace(moving.session, estimate=ARM_ALONE, joint_models=RIGID), force=True)
    assert np.abs(found.estimate.time_offsets - OFFSETS).max() < 3e-4
    assert len(found.document.outliers) == pytest.approx(len(moving.truth.outliers), rel=0.05)


def test_an_arm_at_rest_in_every_frame_determines_no_time_offset_and_that_is_said(true_state: Callable) -> None:
    moving = filmed("elbow3r", 6, 1.0)
    log = moving.session.motion.log
    # The poses of a session at rest, one after the other, each kept while a camera takes its frame.
    q = np.repeat(log.values[:: len(log.values) // 40], 400, axis=0)
    time = 0.01 * np.arange(len(q))
    trajectory = replace(
        moving.session.motion,
        log=JointLog(time, q),
        time=np.resize(2.0 + 4.0 * np.arange(40), len(moving.session.poses)),
    )
    session = replace(moving.session, motion=trajectory, q=trajectory.values(np.zeros(2)))
    problem, state = problem_of(session), true_state(moving, time_offset=np.zeros(2))
    found = identify(problem, state, choose_parameters(session, problem, state, FIXED))
    said = [text for text in found.unidentifiable if "time_offset" in text]
    assert len(said) == 2
    assert all("does not move" in text for text in said)
    assert not found.parameters.active[found.parameters.columns(TIME_OFFSETS)].any()


def test_folds_of_a_moving_arm_are_stretches_of_time() -> None:
    (observed,) = problem_of(filmed("elbow3r", 6, 4.0).session).observations
    motion = observed.readings.motion
    fold = motion.folds(observed.readings.q, 5, seed=0)
    time = motion.time
    assert np.array_equal(np.bincount(fold) // 10, np.full(5, len(time) // 50)) or np.ptp(np.bincount(fold)) <= 1
    assert np.all(np.diff(fold[np.argsort(time)]) >= 0)


def test_frames_are_not_triangulated() -> None:
    with pytest.raises(CalibrationError, match="by one camera"):
        calibrate(filmed("elbow3r", 6, 4.0).session, method="points")


def test_clocks_that_a_session_keeps_stay_in_its_explanation_by_any_arm() -> None:
    # Freed for the calibrated arm alone, they would be counted as its merit.
    session = replace(filmed("elbow3r", 6, 2.0, OFFSETS).session, joint_models={"time_offset": False})
    rigid = FoundJointModels(session.chain, (), STANDARD_GRAVITY)
    drawn, calibrated = (explain(session.chain, session, bends=bends) for bends in (None, rigid))
    np.testing.assert_array_equal(drawn.residuals[0], calibrated.residuals[0])
    assert rms(drawn.residuals[0]) > 1.5 * rms(explain(session.chain, replace(session, joint_models={})).residuals[0])
