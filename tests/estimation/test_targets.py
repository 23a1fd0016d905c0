"""Targets whose pose is one unknown: derivatives, starts and estimates, on a link and in the world."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from tests.estimation.derivatives import assert_derivatives
from tests.estimation.problems import Estimated
from tests.worlds import ALONE, RIGID
from urdfcal.arrays import inverse, rms
from urdfcal.errors import CalibrationError, SessionError
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.blocks.targets import TargetBlock, bend_key, point_places, print_key, target_key
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.start import first_state
from urdfcal.estimation.target_start import hand_eye
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.combine import combine
from urdfcal.session.exclusion import leave_out
from urdfcal.session.knowledge import Estimate, Excluded, Led
from urdfcal.session.moves import resolve_moves
from urdfcal.session.pattern import DotsPattern
from urdfcal.session.target import Target
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.session.model import Session

pytestmark = pytest.mark.usefixtures("no_trials")
RIGS = {"ur5_charuco": "fixed", "panda_handeye": "free", "so101_apriltag": "fixed"}


def unplaced(session: Session) -> Session:
    """The same with nothing known of where targets and cameras sit."""
    targets = tuple(replace(target, T_link_target=None, sigma=None) for target in session.targets)
    mounts = tuple(replace(mount, T_link_camera=None, sigma=None) for mount in session.mounts)
    return replace(session, targets=targets, mounts=mounts)


@pytest.mark.parametrize("rig", RIGS)
def test_every_derivative_agrees_with_finite_differences(rig: str, simulated: Callable, true_state: Callable) -> None:
    data = simulated(rig, poses=5)
    unsure = tuple(replace(of, scale_sigma=0.01, flatness=0.001) for of in data.session.targets)
    session = replace(data.session, targets=unsure)
    problem = Problem.of(session, rows_of(session.chain))
    centre = true_state(replace(data, session=session))
    parameters = choose_parameters(session, problem, centre, ModelSpec("dh", ("free",), (RIGS[rig],)))
    assert {f"{session.targets[0].name}.{axis}" for axis in ("x", "rz", "scale", "bend_xy")} < set(parameters.names)
    state = parameters.retract(centre, np.random.default_rng(0).normal(0.0, 1e-3, parameters.count))
    assert_derivatives(problem, problem.observations[0], state, parameters)


def test_a_block_s_coordinates_are_those_of_its_steps() -> None:
    target = Target("t", DotsPattern(np.eye(3)), T_link_target=pin.SE3.Random().homogeneous, sigma=np.ones(6))
    block = TargetBlock.of(target, np.eye(4), priors=True)
    step = np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6])
    value = block.retract(block.nominal, step)
    coordinates, J = block.local(value)
    np.testing.assert_allclose(coordinates, step, atol=1e-12)
    for k, direction in enumerate(1e-6 * np.eye(6)):
        ahead, behind = (block.local(block.retract(value, sign * direction))[0] for sign in (1, -1))
        np.testing.assert_allclose((ahead - behind) / 2e-6, J[:, k], atol=1e-8)


def test_one_given_as_exact_is_fixed(simulated: Callable) -> None:
    data = simulated("ur5_charuco", poses=12)
    exact = tuple(
        replace(of, T_link_target=T, sigma=np.zeros(6))
        for of, T in zip(data.session.targets, data.truth.targets, strict=True)
    )
    found = calibrate(replace(data.session, targets=exact))
    np.testing.assert_array_equal(found.estimate.targets, data.truth.targets)
    assert found.fit.parameters.reasons["board.x"] == "its pose is given as exact"


@pytest.mark.parametrize("rig", RIGS)
def test_unknown_poses_are_started_from_pictures_alone(rig: str, simulated: Callable) -> None:
    data = simulated(rig)
    session = unplaced(data.session)
    arm = rows_of(session.chain)
    state = first_state(session, arm, no_offsets(arm))
    off = inverse(data.truth.targets[0]) @ state[target_key(session.targets[0].name)]
    assert np.linalg.norm(off[:3, 3]) < 0.02
    assert np.linalg.norm(pin.log3(off[:3, :3])) < 0.02


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("given", [True, False])
def test_the_truth_is_recovered_with_the_claimed_error(rig: str, given: bool, simulated: Callable) -> None:
    data = simulated(rig)
    session = data.session if given else unplaced(data.session)
    found = calibrate(replace(session, estimate=Estimate("dh"), joint_models=RIGID))
    assert found.assessment.level == "good"
    off = pin.log6(pin.SE3(inverse(data.truth.targets[0]) @ found.estimate.targets[0])).vector
    sigma = found.sigmas_of(target_key(data.session.targets[0].name))
    # The last rows of the arm and the target share what only moves both: priors hold it, and count.
    np.testing.assert_array_less(np.abs(off), 4.0 * sigma)
    before, after = (s.reduced_chi2 for s in (found.nominal_fit, found.fit))
    assert after < 1.2 < before


def test_a_print_of_another_size_is_within_what_is_claimed_of_its_scale(simulated: Callable) -> None:
    """A board given 0.3 % too long; all that speaks against it are the links' tolerances."""
    data = simulated("ur5_charuco")
    (target,) = data.session.targets
    longer = replace(target, pattern=replace(target.pattern, square=target.pattern.square * 1.003))
    found = calibrate(replace(data.session, targets=(replace(longer, scale_sigma=0.01),), **ALONE))
    sigma = found.sigmas_of(print_key("board"))[0]
    assert 1e-4 < sigma < 0.005
    assert abs(found.fit.state[print_key("board")][0] - 0.003) < 3.0 * sigma
    assert found.evidence.scale.declared == 0.01
    # Unsaid, the claimed error is conditional on the board's unit of length, and what that is worth is said.
    silent = calibrate(replace(data.session, **ALONE)).evidence.scale
    assert silent.declared is None
    assert 2e-4 < silent.tip_per_permille < 1e-3


@pytest.mark.no_cover
def test_a_bent_print_is_found_as_bent_as_it_is_and_spoils_what_takes_it_for_flat() -> None:
    rig = read_rig(find_rig("ur5_charuco"))
    bent = replace(rig, targets=tuple(replace(target, flatness=1e-3) for target in rig.targets))
    simulated = simulate(bent, poses=20, seed=0)
    (target,) = simulated.session.targets
    off = simulated.truth.leds[simulated.truth.led_count :, 2] - target.points[:, 2]
    assert np.abs(off).max() > 2e-4
    found = calibrate(replace(simulated.session, **ALONE))
    assert found.assessment.level == "good"
    key = bend_key(target.name)
    error = found.fit.state[key] - np.linalg.lstsq(target.bends, off, rcond=None)[0]
    assert (np.abs(error) < 3.5 * found.sigmas_of(key)).all()
    assert (found.sigmas_of(key) < 1e-4).all()
    flat = replace(simulated.session, targets=(replace(target, flatness=None),), **ALONE)
    assert calibrate(flat, force=True).assessment.level != "good"


def test_a_tracker_s_body_of_unknown_pose(simulated: Callable) -> None:
    data = simulated("ur5", poses=20)
    rng = np.random.default_rng(0)
    dots = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.08, 0.0], [0.05, 0.0, 0.06]])
    T_link_target = pin.exp6(np.array([0.05, 0.03, 0.02, 0.5, -0.3, 1.0])).homogeneous
    session = replace(data.session, leds=(), targets=(Target("body", DotsPattern(dots), T_link_target=T_link_target),))
    scene_points = body_points(session, data)
    pose, led = (of.ravel() for of in np.meshgrid(np.arange(20), np.arange(4), indexing="ij"))
    noisy = scene_points.reshape(-1, 3) + rng.normal(0.0, 5e-5, (80, 3))
    unknown = (Target("body", DotsPattern(dots)),)
    measured = Points(pose, led, noisy, np.full(80, 5e-5))
    found = calibrate(replace(session, targets=unknown, measurements=(measured,)))
    assert found.assessment.level == "good"
    off = inverse(T_link_target) @ found.estimate.targets[0]
    assert np.linalg.norm(off[:3, 3]) < 2e-3


def body_points(session: Session, data: object) -> np.ndarray:
    """Where the true arm carries a target's points, (N, M, 3) in the world."""
    from tests.states import state_of

    truth = data.truth
    poses = [target.T_link_target for target in session.targets]
    state = state_of(session, truth.offsets, truth.T_world_base, truth.leds, truth.T_cam_frame, poses)
    points = Points(
        *(of.ravel() for of in np.meshgrid(np.arange(20), np.arange(4), indexing="ij")), np.zeros((80, 3)), 1.0
    )
    session = replace(session, q=truth.q, measurements=(points,))
    problem = Problem.of(session, rows_of(session.chain))
    return problem.predict(problem.observations[0], state)


def test_leds_and_a_target_in_one_session(simulated: Callable) -> None:
    """An LED beside the board, its place unknown: it comes after the board in nothing but the tables."""
    data = simulated("ur5_charuco", poses=20)
    session = unplaced(data.session)
    detections = session.find(Detections)
    # The board's first corner is an LED of its own name, and no part of the board any more.
    mixed = replace(session, leds=(Led("led"),))
    led = np.where(detections.led == 0, 0, detections.led + 1)
    mixed = replace(mixed, measurements=(replace(detections, led=led),))
    found = calibrate(replace(mixed, **ALONE))
    np.testing.assert_allclose(found.estimate.leds[0], found.estimate.targets[0][:3, 3], atol=1e-4)
    assert len(found.estimate.leds) == 25


def test_what_is_excluded_leaves_the_target_whole(simulated: Callable) -> None:
    session = simulated("ur5_charuco", poses=6).session
    less = leave_out(session, Excluded(leds=("board:3",)))
    assert less.led_names == session.led_names
    assert len(less.find(Detections)) == len(session.find(Detections)) - 6
    assert 3 not in less.find(Detections).led


def test_hand_eye_chooses_among_mirrored_poses_and_leaves_out_what_is_wrong() -> None:
    rng = np.random.default_rng(0)
    pin.seed(0)
    X, Y = pin.SE3.Random().homogeneous, pin.SE3.Random().homogeneous
    B = np.array([pin.SE3.Random().homogeneous for _ in range(20)])
    A = Y @ B @ X @ np.array([pin.exp6(rng.normal(0.0, 1e-4, 6)).homogeneous for _ in B])
    mirrored = A @ np.diag([1.0, -1.0, -1.0, 1.0])
    swapped = rng.random(20) < 0.3
    hypotheses = np.where(swapped[:, None, None, None], np.stack([mirrored, A], 1), np.stack([A, mirrored], 1))
    hypotheses[3] = np.eye(4)
    found = hand_eye("t", hypotheses, B)
    for T, true in zip(found, (Y, X), strict=True):
        np.testing.assert_allclose(T, true, atol=1e-3)


def test_an_arm_that_turns_about_one_axis_does_not_tell() -> None:
    X, Y = pin.SE3.Random().homogeneous, pin.SE3.Random().homogeneous
    B = np.array([pin.SE3(pin.exp3(np.array([0.0, 0.0, a])), np.array([a, 0.1, 0.0])).homogeneous for a in range(6)])
    with pytest.raises(CalibrationError, match=r"turned about one axis alone.*target 't'.*position and rpy"):
        hand_eye("t", (Y @ B @ X)[:, None], B)
    with pytest.raises(CalibrationError, match=r"target 't' was seen.*in 2 poses: three are needed"):
        hand_eye("t", (Y @ B @ X)[:2, None], B[:2])


def test_points_are_placed_by_their_target_s_print(simulated: Callable, true_state: Callable) -> None:
    data = simulated("ur5_charuco", poses=5)
    session = replace(data.session, targets=tuple(replace(of, scale_sigma=0.01) for of in data.session.targets))
    state = true_state(replace(data, session=session)).replace({print_key("board"): np.array([0.1])})
    np.testing.assert_allclose(point_places(session.attachments, state), session.targets[0].points / 1.1)


def test_a_target_far_from_where_the_session_puts_it_is_named(simulated: Callable) -> None:
    data = simulated("ur5_charuco")
    (target,) = data.session.targets
    T = target.T_link_target @ pin.exp6(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0])).homogeneous
    found = calibrate(replace(data.session, targets=(replace(target, T_link_target=T),), **ALONE), force=True)
    (warning,) = (text for text in found.warnings if "comes out" in text)
    assert warning.startswith("target 'board' comes out ")
    assert "from where the session puts it" in warning


def test_sessions_with_targets_are_combined(simulated: Callable) -> None:
    data = simulated("ur5_charuco", poses=24)
    halves = [
        leave_out(data.session, Excluded(poses=some)) for some in (data.session.poses[12:], data.session.poses[:12])
    ]
    both = combine(dict(zip(("monday", "tuesday"), halves, strict=True)))
    assert [target.name for target in both.targets] == ["monday/board", "tuesday/board"]
    chain = data.session.chain
    q = chain.random_values(200, np.random.default_rng(0))
    true = chain.with_placements(data.truth.placements)
    together, alone = (
        rms(compare(chain.with_placements(Estimated.of(session).placements), true, q).position)
        for session in (both, halves[0])
    )
    assert together < 0.8 * alone


def test_points_of_targets_do_not_move(simulated: Callable) -> None:
    session = simulated("ur5_charuco", poses=6).session
    with pytest.raises(SessionError, match="cannot have moved in a session with targets"):
        resolve_moves(replace(session, moved={"board:3": (session.poses[3],)}))
