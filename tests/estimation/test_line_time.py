"""Rolling shutters before a moving arm: rows are taken one after the other, and the time between them is found."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.derivatives import assert_derivatives
from tests.estimation.problems import Estimated
from tests.worlds import ALONE, RIGID
from urdfcal.estimation.joint_models.time_offset import TIME_OFFSETS
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.knowledge import Estimate
from urdfcal.simulation.motion import MotionSettings, set_in_motion
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.simulation.truth import Simulated

LINE, SIGMA = 2.2e-5, 4e-6


@cache
def filmed(rig: str, poses: int, rate: float, sigma: float = SIGMA, seed: int = 0) -> Simulated:
    description = read_rig(find_rig(rig))
    cameras = [replace(one, line_time=LINE, line_time_sigma=sigma) for one in description.rig.cameras]
    rolling = replace(description, rig=replace(description.rig, cameras=tuple(cameras)))
    return set_in_motion(simulate(rolling, poses=poses, seed=seed), MotionSettings(frame_rate=rate))


def clocks(simulated: Simulated) -> np.ndarray:
    """The true offsets, then the true line times."""
    return np.concatenate([simulated.truth.time_offsets, [of.line_time for of in simulated.truth.cameras]])


@pytest.mark.parametrize("rig", ["elbow3r", "so101_apriltag"])
def test_derivatives_agree_with_finite_differences(rig: str, true_state: Callable) -> None:
    simulated = filmed(rig, 4, 3.0)
    session = simulated.session.at(np.arange(0, len(simulated.session.poses), 8))
    problem = Problem.of(session, rows_of(session.chain))
    state = true_state(replace(simulated, session=session), time_offset=clocks(simulated))
    fixed = ("fixed",) * len(session.rig.cameras)
    parameters = choose_parameters(session, problem, state, ModelSpec("dh", fixed, fixed))
    assert parameters.has_active(TIME_OFFSETS)
    assert_derivatives(problem, problem.observations[0], state, parameters)


def test_with_the_true_values_what_is_left_is_noise(true_state: Callable) -> None:
    """Without the line times half a pixel would be left and more."""
    simulated = filmed("elbow3r", 6, 10.0)
    problem, true = Problem.of(simulated.session, rows_of(simulated.session.chain)), clocks(simulated)
    left = []
    for values in (true, np.concatenate([true[:2], [0.0, 0.0]])):
        state = true_state(simulated, time_offset=values)
        left.append(float(np.std(problem.residual(problem.observations[0], state))))
    assert left[0] < 0.12
    assert left[1] > 0.5


def off(found: FittedCalibration | Estimated, simulated: Simulated) -> np.ndarray:
    """How far offsets and line times are off, in their standard deviations."""
    return np.asarray((found.fit.state[TIME_OFFSETS] - clocks(simulated)) / found.sigmas_of(TIME_OFFSETS))


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", range(3))
def test_line_times_are_found_to_what_is_claimed(seed: int) -> None:
    simulated = filmed("elbow3r", 6, 8.0, seed=seed)
    found = Estimated.of(simulated.session)
    assert np.abs(off(found, simulated)).max() < 3.5
    assert (found.sigmas_of(TIME_OFFSETS)[2:] < 0.2 * SIGMA).all()


@pytest.mark.no_cover
def test_points_of_a_board_at_several_rows_of_an_image_and_coarse_encoders_do_not_bend_it() -> None:
    """The velocities of a curve through readings of 0.4 mrad at 125 Hz would make it a fifth too small."""
    simulated = filmed("so101_apriltag", 8, 8.0)
    calibration = calibrate(replace(simulated.session, estimate=Estimate("dh"), joint_models=RIGID))
    assert np.abs(off(calibration, simulated)).max() < 3.5
    assert calibration.estimate.time_offsets[1] == pytest.approx(clocks(simulated)[1], rel=0.1)
    assert calibration.assessment.level == "good"


@pytest.mark.no_cover
def test_what_is_known_is_used_and_not_estimated() -> None:
    simulated = filmed("elbow3r", 6, 4.0, sigma=0.0)
    offsets = simulated.truth.time_offsets
    fixed = replace(simulated.session, estimate=Estimate(time_offset="fixed"))
    free = calibrate(replace(simulated.session, **ALONE))
    camera = free.to_dict()["cameras"]["cam0"]
    assert camera["line_time"] == {"value": LINE, "sigma": None}
    assert abs(camera["time_offset"]["value"] - offsets[0]) < 4.0 * camera["time_offset"]["sigma"]
    known = set_in_motion(
        simulate(read_rig(find_rig("elbow3r")), poses=6, seed=0),
        MotionSettings(frame_rate=4.0, time_offsets=(0.0, 0.0)),
    )
    known = replace(known.session, **ALONE)
    assert "line_time" not in calibrate(known).to_dict()["cameras"]["cam0"]
    problem = Problem.of(fixed, rows_of(fixed.chain))
    (model,) = [model for model in problem.joint_models if model.name == "time_offset"]
    assert not model.active.any()
    np.testing.assert_array_equal(model.nominal, [0.0, 0.0, LINE, LINE])
