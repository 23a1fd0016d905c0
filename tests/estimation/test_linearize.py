from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.derivatives import assert_derivatives
from tests.states import at_joint_values, state_of
from urdfcal.arrays import inverse
from urdfcal.cameras.rig import Rig
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.robot.chain import read_mechanism
from urdfcal.robot.dh import DHTable
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.attachments import CameraMount
from urdfcal.session.knowledge import Led
from urdfcal.simulation.scene import look_at

if TYPE_CHECKING:
    from collections.abc import Callable

EVERY = slice(None)


RIGS = {
    "elbow3r": ("fixed", "free"),
    "panda": ("fixed", "free"),
    "stanford": ("fixed", "free"),
    "tiago": ("free",),
    "tiago_dual": ("fixed", "free"),
    "ur5_handeye": ("free",),
}


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", RIGS)
def test_every_jacobian_block_agrees_with_finite_differences(
    rig: str, simulated: Callable, true_state: Callable
) -> None:
    session = simulated(rig, poses=8).session
    problem = Problem.of(session, rows_of(session.chain))
    (observed,) = problem.observations
    centre = true_state(simulated(rig, poses=8))
    extrinsics = RIGS[rig]
    parameters = choose_parameters(session, problem, centre, ModelSpec("dh", ("free",) * len(extrinsics), extrinsics))
    state = parameters.retract(centre, np.random.default_rng(0).normal(0.0, 1e-3, parameters.count))
    assert_derivatives(problem, observed, state, parameters)
    step = np.random.default_rng(1).normal(0.0, 1e-6, parameters.count)
    np.testing.assert_allclose(parameters.between(state, parameters.retract(state, step)), step, rtol=1e-3, atol=1e-9)


def test_all_attachments_at_once_agree_with_finite_differences(simulated: Callable) -> None:
    """An eye-to-hand camera, two on one link; LEDs in the world, on the base link, on the way, and on the tip."""
    hand = simulated("ur5_handeye", poses=8).session
    T_world_base = inverse(look_at(np.array([1.8, -0.6, 0.9]), np.array([0.5, 0.0, 0.1])))
    in_world = T_world_base[:3, :3] @ [0.5, -0.05, 0.0] + T_world_base[:3, 3]
    positions = {
        "world": in_world,
        "base": [-0.55, 0.05, 0.02],
        "forearm_link": [0.0, 0.05, 0.1],
        "tool0": [0.0, 0.0, 0.1],
    }
    (lens,) = hand.rig.cameras
    aside = np.eye(4)
    aside[0, 3] = -0.1
    seen = [(0, led) for led in range(4)] + [(camera, led) for camera in (1, 2) for led in (0, 1, 3)]
    camera, led = np.array([pair for _ in hand.poses for pair in seen]).T
    pose = np.repeat(np.arange(8), len(seen))
    session = replace(
        hand,
        chain=read_mechanism(hand.urdf, ["tool0", "forearm_link", "base"], "base_link"),
        leds=tuple(Led(link, np.array(position), link=link) for link, position in positions.items()),
        rig=Rig(tuple(replace(lens, name=name) for name in "abc"), (np.eye(4), None, None)),
        mounts=(replace(hand.mounts[0], camera="b"), CameraMount("c", "tool0")),
        measurements=(Detections(pose, camera, led, np.zeros((len(pose), 2)), np.ones(len(pose))),),
    )
    T_link_b = hand.mounts[0].T_link_camera
    table = rows_of(session.chain)
    problem = Problem.of(session, table)
    (observed,) = problem.observations
    assert observed.row.shape == (8, len(seen))
    leds = np.array([led.position for led in session.leds])
    T_cam_frame = np.array([np.eye(4), inverse(T_link_b), aside @ inverse(T_link_b)])
    centre = state_of(session, np.zeros_like(table.nominal), T_world_base, leds, T_cam_frame)
    assert session.attachments.reference.tolist() == [0, 1, 1]
    spec = ModelSpec("dh", ("free",) * 3, ("fixed", "free", "free"))
    parameters = choose_parameters(session, problem, centre, spec)
    state = parameters.retract(centre, np.random.default_rng(0).normal(0.0, 1e-3, parameters.count))
    assert np.isfinite(problem.predict(observed, state)).all()
    assert_derivatives(problem, observed, state, parameters)


@pytest.mark.parametrize("rig", ["stanford", "tiago", "tiago_dual", "ur5_handeye"])
def test_the_derivative_by_joint_readings_agrees_with_finite_differences(
    rig: str, simulated: Callable, true_state: Callable
) -> None:
    data = simulated(rig, poses=8)
    problem = Problem.of(data.session, rows_of(data.session.chain))
    (observed,) = problem.observations
    state = true_state(data)
    fixed = ("fixed",) * len(data.session.rig.cameras)
    parameters = choose_parameters(data.session, problem, state, ModelSpec("none", fixed, fixed))
    q = observed.readings.q
    J_q = Tangent.at(problem, observed, state, parameters).linearise(EVERY).J_q
    J_q = J_q.reshape(*observed.value.shape, q.shape[1])
    for i in range(q.shape[1]):
        step = 1e-6 * np.eye(q.shape[1])[i]
        before, after = (problem.residual(at_joint_values(observed, q + s * step), state) for s in (-1, 1))
        np.testing.assert_allclose(J_q[..., i], (after - before) / 2e-6, rtol=1e-6, atol=1e-3)


def test_points_have_the_same_derivatives_as_pixels(simulated: Callable, true_state: Callable) -> None:
    data = simulated("elbow3r", poses=8)
    points = Points(np.arange(8), np.zeros(8, int), np.zeros((8, 3)), np.ones(8))
    state, session = true_state(data), replace(data.session, measurements=(points,))
    problem = Problem.of(session, DHTable.from_chain(session.chain))
    (observed,) = problem.observations
    parameters = choose_parameters(session, problem, state, ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2))
    assert {block.key for block in parameters.blocks} == {ARM, BASE, LEDS}
    assert parameters.has_active(BASE)
    J = Tangent.at(problem, observed, state, parameters).linearise(EVERY).J
    for k in range(parameters.count):
        step = 1e-6 * np.eye(parameters.count)[k]
        before, after = (problem.predict(observed, parameters.retract(state, s * step)) for s in (-1, 1))
        np.testing.assert_allclose(J[..., k], (after - before) / 2e-6, atol=1e-8)


def test_blocks_of_poses_add_up(simulated: Callable, true_state: Callable) -> None:
    data = simulated("ur5", poses=12)
    problem, state = Problem.of(data.session, DHTable.from_chain(data.session.chain)), true_state(data)
    (observed,) = problem.observations
    parameters = choose_parameters(data.session, problem, state, ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2))
    whole = Tangent.at(problem, observed, state, parameters).linearise(EVERY)
    parts = [Tangent.at(problem, observed, state, parameters).linearise(slice(a, a + 5)) for a in (0, 5, 10)]
    np.testing.assert_array_equal(whole.residual, np.concatenate([part.residual for part in parts]))
    np.testing.assert_allclose(whole.J, np.concatenate([part.J for part in parts]), atol=1e-12)


def test_padding_pulls_at_nothing(simulated: Callable, true_state: Callable) -> None:
    data = simulated("elbow3r", poses=8)
    detections = data.session.find(Detections)
    keep = np.arange(len(detections)) != 3  # one camera missed one pose
    fewer = replace(data.session, measurements=(detections.rows(keep),))
    problem, state = Problem.of(fewer, DHTable.from_chain(fewer.chain)), true_state(data)
    (observed,) = problem.observations
    parameters = choose_parameters(fewer, problem, state, ModelSpec("dh", ("free", "fixed"), ("fixed", "free")))
    at = Tangent.at(problem, observed, state, parameters).linearise(EVERY)
    assert observed.count == keep.sum()
    assert np.count_nonzero(~observed.valid) == 1
    assert not np.any(at.J[~observed.valid])
    assert not np.any(at.residual[~observed.valid])
    np.testing.assert_array_equal(observed.by_row(observed.value), fewer.find(Detections).uv)
