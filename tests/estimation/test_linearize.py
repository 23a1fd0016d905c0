from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.arrays import inverse
from urdfcal.cameras.rig import Rig
from urdfcal.estimation.linearize import Tangent, predict
from urdfcal.estimation.model_spec import Freedoms
from urdfcal.estimation.observations import arrange, observe
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.state import State
from urdfcal.robot.chain import read_mechanism
from urdfcal.robot.dh import DHTable
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.attachments import CameraMount
from urdfcal.session.model import Led, Points
from urdfcal.simulation.scene import look_at

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Geometry, Parameters

EVERY = slice(None)


RIGS = {
    "elbow3r": ("fixed", "free"),
    "panda": ("fixed", "free"),
    "stanford": ("fixed", "free"),
    "tiago": ("free",),
    "tiago_dual": ("fixed", "free"),
    "ur5_handeye": ("free",),
}


def assert_derivatives(table: Geometry, block: Observations, state: State, parameters: Parameters) -> None:
    """By every active parameter, against finite differences."""
    J = Tangent.at(table, block, state, parameters).linearise(EVERY).J
    names = [name for name, active in zip(parameters.names, parameters.active, strict=True) if active]
    for k, name in enumerate(names):
        step = np.zeros(parameters.count)
        step[k] = 1e-5 if name.endswith(("x", "y", "fx", "fy", "cx", "cy")) else 1e-6
        before, after = (
            Tangent.at(table, block, parameters.move(state, s * step), parameters).linearise(EVERY) for s in (-1, 1)
        )
        numeric = (after.residual - before.residual) / (2 * step[k])
        scale = max(np.abs(numeric).max(), 1.0)  # px a metre or radian: less is nothing
        assert np.abs(J[..., k] - numeric).max() < 1e-6 * scale, name


@pytest.mark.parametrize("rig", RIGS)
def test_every_jacobian_block_agrees_with_finite_differences(
    rig: str, simulated: Callable, true_state: Callable
) -> None:
    session = simulated(rig, poses=8).session
    table = rows_of(session.chain)
    (block,) = observe(session)
    centre = true_state(simulated(rig, poses=8))
    extrinsics = RIGS[rig]
    parameters = choose_parameters(session, table, centre, Freedoms("dh", ("free",) * len(extrinsics), extrinsics))
    state = parameters.move(centre, np.random.default_rng(0).normal(0.0, 1e-3, parameters.count))
    assert_derivatives(table, block, state, parameters)


def test_all_ways_of_fastening_at_once_agree_with_finite_differences(simulated: Callable) -> None:
    """A camera that stands, two that ride together; LEDs in the world, on the base link, on the way, and on the tip."""
    hand = simulated("ur5_handeye", poses=8).session
    T_world_base = inverse(look_at(np.array([1.8, -0.6, 0.9]), np.array([0.5, 0.0, 0.1])))
    in_world = T_world_base[:3, :3] @ [0.5, -0.05, 0.0] + T_world_base[:3, 3]
    places = {
        "world": in_world,
        "base": [-0.55, 0.05, 0.02],
        "forearm_link": [0.0, 0.05, 0.1],
        "tool0": [0.0, 0.0, 0.1],
    }
    (lens,) = hand.rig.cameras
    aside = np.eye(4)
    aside[0, 3] = -0.1
    session = replace(
        hand,
        chain=read_mechanism(hand.urdf, ["tool0", "forearm_link", "base"], "base_link"),
        leds=tuple(Led(link, np.array(place), link=link) for link, place in places.items()),
        rig=Rig(tuple(replace(lens, name=name) for name in "abc"), (np.eye(4), None, None)),
        mounts=(replace(hand.mounts[0], camera="b"), CameraMount("c", "tool0")),
        detections=None,
        points=Points(np.zeros(1, int), np.zeros(1, int), np.zeros((1, 3)), np.ones(1)),
    )
    T_link_b = hand.mounts[0].T_link_camera
    seen = [(0, led) for led in range(4)] + [(camera, led) for camera in (1, 2) for led in (0, 1, 3)]
    camera, led = np.array([pair for _ in session.poses for pair in seen]).T
    pose = np.repeat(np.arange(8), len(seen))
    covariance = np.broadcast_to(np.eye(2), (len(pose), 2, 2))
    block = arrange(session.q, pose, led, camera, np.zeros((len(pose), 2)), covariance, session.frames)
    table = rows_of(session.chain)
    centre = State(
        np.zeros_like(table.nominal),
        T_world_base,
        np.array([led.position for led in session.leds]),
        session.rig.cameras,
        np.array([np.eye(4), inverse(T_link_b), aside @ inverse(T_link_b)]),
    )
    assert session.frames.leader.tolist() == [0, 1, 1]
    parameters = choose_parameters(session, table, centre, Freedoms("dh", ("free",) * 3, ("fixed", "free", "free")))
    state = parameters.move(centre, np.random.default_rng(0).normal(0.0, 1e-3, parameters.count))
    assert np.isfinite(predict(table, block, state)).all()
    assert_derivatives(table, block, state, parameters)


@pytest.mark.parametrize("rig", ["stanford", "tiago", "tiago_dual", "ur5_handeye"])
def test_the_derivative_by_joint_readings_agrees_with_finite_differences(
    rig: str, simulated: Callable, true_state: Callable
) -> None:
    data = simulated(rig, poses=8)
    table = rows_of(data.session.chain)
    (block,) = observe(data.session)
    state = true_state(data)
    fixed = ("fixed",) * len(data.session.rig.cameras)
    parameters = choose_parameters(data.session, table, state, Freedoms("none", fixed, fixed))
    J_q = Tangent.at(table, block, state, parameters).linearise(EVERY).by_joints(table.chain)
    for i in range(block.q.shape[1]):
        step = 1e-6 * np.eye(block.q.shape[1])[i]
        before, after = (predict(table, replace(block, q=block.q + s * step), state) for s in (-1, 1))
        np.testing.assert_allclose(J_q[..., i], (after - before) / 2e-6, rtol=1e-6, atol=1e-3)


def test_points_have_the_same_derivatives_as_pixels(simulated: Callable, true_state: Callable) -> None:
    data = simulated("elbow3r", poses=8)
    state, session = true_state(data), data.session
    table = DHTable.from_chain(session.chain)
    pose = np.arange(8)
    block = arrange(
        session.q,
        pose,
        np.zeros(8, int),
        np.full(8, -1),
        np.zeros((8, 3)),
        np.broadcast_to(np.eye(3), (8, 3, 3)),
        session.frames,
    )
    parameters = choose_parameters(session, table, state, Freedoms("dh", ("fixed",) * 2, ("fixed",) * 2))
    J = Tangent.at(table, block, state, parameters).linearise(EVERY).J
    for k in range(parameters.count):
        step = 1e-6 * np.eye(parameters.count)[k]
        before, after = (predict(table, block, parameters.move(state, s * step)) for s in (-1, 1))
        np.testing.assert_allclose(J[..., k], (after - before) / 2e-6, atol=1e-8)


def test_blocks_of_poses_add_up(simulated: Callable, true_state: Callable) -> None:
    data = simulated("ur5", poses=12)
    table, state = DHTable.from_chain(data.session.chain), true_state(data)
    (block,) = observe(data.session)
    parameters = choose_parameters(data.session, table, state, Freedoms("dh", ("fixed",) * 2, ("fixed",) * 2))
    whole = Tangent.at(table, block, state, parameters).linearise(EVERY)
    parts = [Tangent.at(table, block, state, parameters).linearise(slice(a, a + 5)) for a in (0, 5, 10)]
    np.testing.assert_array_equal(whole.residual, np.concatenate([part.residual for part in parts]))
    np.testing.assert_allclose(whole.J, np.concatenate([part.J for part in parts]), atol=1e-12)


def test_padding_pulls_at_nothing(simulated: Callable, true_state: Callable) -> None:
    data = simulated("elbow3r", poses=8)
    session, d = data.session, data.session.detections
    keep = np.arange(len(d.pose)) != 3  # one camera missed one pose
    fewer = replace(
        session,
        detections=type(d)(d.pose[keep], d.camera[keep], d.led[keep], d.uv[keep], d.sigma[keep]),
    )
    table, state = DHTable.from_chain(session.chain), true_state(data)
    (block,) = observe(fewer)
    parameters = choose_parameters(fewer, table, state, Freedoms("dh", ("free", "fixed"), ("fixed", "free")))
    at = Tangent.at(table, block, state, parameters).linearise(EVERY)
    assert block.count == keep.sum()
    assert np.count_nonzero(~block.valid) == 1
    assert not np.any(at.J[~block.valid])
    assert not np.any(at.residual[~block.valid])
    np.testing.assert_array_equal(block.by_row(block.value), fewer.detections.uv)
