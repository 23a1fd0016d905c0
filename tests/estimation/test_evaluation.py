from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.errors import RobotError
from urdfcal.estimation.evaluation import Spread, compare, explain

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.robot.chain import Chain


@pytest.fixture
def chain(simulated: Callable) -> Chain:
    return simulated("ur5").session.chain


def moved_at_the_base(chain: Chain, motion: np.ndarray) -> tuple[Chain, np.ndarray]:
    """The chain with its first joint elsewhere on the base link, and the base link's old pose in its new one."""
    T = pin.exp6(motion).homogeneous
    return replace(chain, placements=np.concatenate([[T @ chain.placements[0]], chain.placements[1:]])), T


def test_how_a_robot_is_bolted_down_makes_no_difference(chain: Chain) -> None:
    other, T = moved_at_the_base(chain, np.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.3]))
    q = chain.random_values(50, np.random.default_rng(0))
    difference = compare(chain, other, q)
    assert difference.position.max() < 1e-12
    assert difference.orientation.max() < 1e-12
    np.testing.assert_allclose(difference.T_a_b, np.linalg.inv(T), atol=1e-12)
    assert difference.position_unaligned.min() > 0.01
    np.testing.assert_allclose(difference.orientation_unaligned, np.linalg.norm([0.2, 0.1, -0.3]), rtol=1e-9)


def test_a_link_that_is_longer_remains_after_alignment(chain: Chain) -> None:
    placements = np.array(chain.placements)
    placements[2, 0, 3] += 0.002
    q = chain.random_values(200, np.random.default_rng(0))
    difference = compare(chain, replace(chain, placements=placements), q)
    np.testing.assert_allclose(difference.position_unaligned, 0.002, atol=1e-9)
    assert 0.0002 < np.sqrt(np.mean(difference.position**2)) < 0.002


def test_tips_on_a_line_are_aligned_by_their_axes_too(chain: Chain) -> None:
    other, _ = moved_at_the_base(chain, np.array([0.0, 0.0, 0.0, 0.1, 0.2, 0.3]))
    q = chain.random_values(1, np.random.default_rng(0)) + np.zeros((5, 6))
    assert compare(chain, other, q).orientation.max() < 1e-9


def test_robots_of_other_joints_are_not_compared(chain: Chain, simulated: Callable) -> None:
    with pytest.raises(RobotError, match="different joints"):
        compare(chain, simulated("elbow3r").session.chain, np.zeros((1, 6)))


def test_the_true_arm_explains_a_session_to_its_noise(simulated: Callable) -> None:
    data = simulated("elbow3r")
    true = replace(data.session.chain, placements=data.truth.placements)
    (good,), (bad,) = (explain(chain, data.session).residuals for chain in (true, data.session.chain))
    assert 0.08 < np.sqrt(np.mean(good**2)) < 0.11
    assert np.sqrt(np.mean(bad**2)) > 3.0 * np.sqrt(np.mean(good**2))


def test_five_numbers_of_a_spread() -> None:
    spread = Spread.of(np.arange(101.0))
    assert (spread.mean, spread.median, spread.p95, spread.max) == (50.0, 50.0, 95.0, 100.0)
    assert spread.rms == pytest.approx(np.sqrt(3350.0))
    assert np.isnan(Spread.of(np.zeros(0)).rms)


def test_a_tool_that_is_turned_on_its_link_does_not_move_the_alignment(chain: Chain) -> None:
    T_last_tip = chain.T_last_tip @ pin.exp6(np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0])).homogeneous
    turned = replace(chain, tips=(replace(chain.tips[0], T_joint_link=T_last_tip),))
    difference = compare(chain, turned, chain.random_values(50, np.random.default_rng(0)))
    assert difference.position.max() < 1e-12
    np.testing.assert_allclose(difference.orientation, 0.5, rtol=1e-9)
