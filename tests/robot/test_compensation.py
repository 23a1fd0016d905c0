from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.errors import RobotError
from urdfcal.robot.compensation import compensate, compensate_one
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.newton import AsTold, TipAtOnce

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.robot.chain import Chain


@pytest.fixture(params=["ur5", "panda", "elbow3r", "so101", "stanford"])
def arms(request: pytest.FixtureRequest, simulated: Callable) -> tuple[Chain, Chain]:
    """An arm nominal and calibrated."""
    data = simulated(request.param)
    nominal = data.session.chain
    return nominal, replace(nominal, placements=data.truth.placements)


def readings(chain: Chain, count: int) -> np.ndarray:
    values = chain.random_values(count, np.random.default_rng(7))
    return values[:, [name in chain.actuated for name in chain.names]]


def left(nominal: Chain, real: Chain, expected: np.ndarray, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    T = tip_poses(nominal, nominal.joint_values(expected))
    T_real = tip_poses(real, real.joint_values(commands))
    angle = [np.linalg.norm(pin.log3(a[:3, :3] @ b[:3, :3].T)) for a, b in zip(T, T_real, strict=True)]
    return np.linalg.norm((T - T_real)[:, :3, 3], axis=1), np.array(angle)


def test_the_real_tip_goes_where_the_nominal_one_would(arms: tuple[Chain, Chain]) -> None:
    nominal, real = arms
    expected = readings(nominal, 500)
    before, _ = left(nominal, real, expected, expected)
    found = compensate(nominal, real, expected)
    position, angle = left(nominal, real, expected, found.q)
    np.testing.assert_allclose(found.position, position, atol=1e-12)
    np.testing.assert_allclose(found.angle, angle, atol=1e-7)
    assert np.median(before) > 5e-4
    assert np.median(position) < 1e-8
    assert np.quantile(position, 0.95) < 0.1 * np.median(before)
    assert np.all(position <= before + 1e-12)
    if len(nominal.actuated) >= 6:
        assert np.median(angle) < 1e-8


def test_limits_hold_and_joints_stay_near_their_command(arms: tuple[Chain, Chain]) -> None:
    nominal, real = arms
    expected = readings(nominal, 300)
    joints = [joint for joint in nominal.joints if joint.mimic is None]
    lower, upper = np.array([j.lower for j in joints]), np.array([j.upper for j in joints])
    expected[::3] = np.where(np.isfinite(lower), lower, expected[::3])
    expected[1::3] = np.where(np.isfinite(upper), upper, expected[1::3])
    found = compensate(nominal, real, expected)
    assert np.all((found.q >= lower) & (found.q <= upper))
    assert np.abs(found.q - expected).max() < 0.31


def test_a_nominal_arm_needs_no_compensation(arms: tuple[Chain, Chain]) -> None:
    nominal, _ = arms
    expected = readings(nominal, 50)
    found = compensate(nominal, nominal, expected)
    np.testing.assert_array_equal(found.q, expected)
    assert found.position.max() < 1e-15


def test_poses_do_not_depend_on_their_company(arms: tuple[Chain, Chain]) -> None:
    nominal, real = arms
    expected = readings(nominal, 8)
    together = compensate(nominal, real, expected).q
    alone = np.array([compensate(nominal, real, one).q for one in expected])
    np.testing.assert_allclose(together, alone, atol=1e-9)


def test_a_tip_out_of_reach_says_by_how_much(simulated: Callable) -> None:
    nominal = simulated("elbow3r").session.chain
    shorter = np.array(nominal.placements)
    shorter[:, :3, 3] *= 0.99
    stretched = np.zeros((1, 3))
    found = compensate(nominal, replace(nominal, placements=shorter), stretched)
    position, _ = left(nominal, replace(nominal, placements=shorter), stretched, found.q)
    assert found.position[0] == pytest.approx(position[0])
    assert found.position[0] > 1e-3


@pytest.mark.parametrize(
    ("expected", "message"),
    [
        ([[0.0, 90.0, 0.0, 0.0, 0.0, 0.0]], "shoulder_lift_joint.*outside the joint.s limits"),
        ([[0.0, np.nan, 0.0, 0.0, 0.0, 0.0]], "outside the joint.s limits"),
        ([[0.0, 0.0]], r"not \(\.\.\., 6\)"),
    ],
)
def test_commands_that_are_none_are_refused(expected: list[list[float]], message: str, simulated: Callable) -> None:
    chain = simulated("ur5").session.chain
    with pytest.raises(RobotError, match=message):
        compensate(chain, chain, expected)


def test_one_command_takes_the_tip_where_many_do(arms: tuple[Chain, Chain]) -> None:
    """At singularities and limits, too: there plain steps do not do, and both take the same way."""
    nominal, real = arms
    expected = readings(nominal, 150)
    expected[:10] = 0.0
    lower, upper = nominal.limits
    expected = np.clip(expected, lower, upper)
    expected[10:20] = np.where(np.isfinite(upper), upper, expected[10:20])
    tips = TipAtOnce(nominal), TipAtOnce(real)
    quick = [compensate_one(*tips, q, AsTold(real)) for q in expected]
    together = compensate(nominal, real, expected)
    plain = np.array([k for k, one in enumerate(quick) if one is not None])
    assert len(plain) > 0.8 * (len(expected) - 20)
    commands = np.array([quick[k].q for k in plain])
    tip, same = (tip_poses(real, real.joint_values(q))[:, :3, 3] for q in (commands, together.q[plain]))
    np.testing.assert_allclose(tip, same, atol=1e-9)
    position, angle = left(nominal, real, expected[plain], commands)
    np.testing.assert_allclose([quick[k].position for k in plain], position, atol=1e-12)
    np.testing.assert_allclose([quick[k].angle for k in plain], angle, atol=1e-7)
    assert np.all((commands >= lower) & (commands <= upper))


def test_the_tip_at_once_is_that_of_many(arms: tuple[Chain, Chain]) -> None:
    _, real = arms
    tip, q = TipAtOnce(real), readings(real, 5)
    for one, T in zip(q, tip_poses(real, real.joint_values(q)), strict=True):
        values = tip.told.values(one)
        np.testing.assert_allclose(values, real.joint_values(one), atol=1e-15)
        np.testing.assert_allclose(tip.pose(values).homogeneous, T, atol=1e-14)
        same, J = tip.jacobian(values)
        np.testing.assert_allclose(same.homogeneous, T, atol=1e-14)
        for j in range(len(values)):
            step = 1e-6 * np.eye(len(values))[j]
            ahead, behind = tip.pose(values + step), tip.pose(values - step)
            turned = pin.log3(ahead.rotation @ behind.rotation.T)
            moved = np.concatenate([ahead.translation - behind.translation, turned])
            np.testing.assert_allclose(J[:, j], moved / 2e-6, atol=1e-8)
