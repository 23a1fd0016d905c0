from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import direction
from urdfcal import RealtimeKinematics
from urdfcal.errors import RobotError
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.mechanism import BASE, Mechanism

if TYPE_CHECKING:
    from urdfcal.arrays import Floats

RIGS = ("ur5", "panda", "so101", "stanford", "tiago")
COUNT = 100


def chain_of(rig: str) -> Mechanism:
    return read_rig(find_rig(rig)).chain


def inside(chain: Mechanism, count: int = COUNT, seed: int = 0) -> Floats:
    """Readings away from the limits."""
    lower, upper = chain.limits
    lower, upper = np.maximum(lower, -2.5), np.minimum(upper, 2.5)
    return lower + (upper - lower) * np.random.default_rng(seed).uniform(0.15, 0.85, (count, len(lower)))


@pytest.mark.parametrize("rig", RIGS)
def test_poses_and_jacobians_are_those_of_the_mechanism(rig: str) -> None:
    chain = chain_of(rig)
    arm, q = RealtimeKinematics(chain), inside(chain, 5)
    poses = np.array([arm.forward(one) for one in q])
    np.testing.assert_allclose(poses, tip_poses(chain, chain.joint_values(q)), atol=1e-14)
    step = 1e-6
    for one, T in zip(q, poses, strict=True):
        J = arm.jacobian(one)
        for i, of in enumerate(np.eye(len(one)) * step):
            ahead, behind = arm.forward(one + of), arm.forward(one - of)
            np.testing.assert_allclose(J[:3, i], (ahead - behind)[:3, 3] / (2 * step), atol=1e-8)
            W = (ahead - behind)[:3, :3] / (2 * step) @ T[:3, :3].T
            np.testing.assert_allclose(J[3:, i], [W[2, 1], W[0, 2], W[1, 0]], atol=1e-8)


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize(("away", "found", "steps"), [(0.02, 0.98, 5), (0.2, 0.95, 8)])
def test_the_inverse_reaches_poses_near_by(
    rig: str, away: float, found: float, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By at most so many evaluations (median), which is what takes the time."""
    chain = chain_of(rig)
    arm, q = RealtimeKinematics(chain), inside(chain)
    looked = []
    local = RealtimeKinematics._local
    monkeypatch.setattr(RealtimeKinematics, "_local", lambda *of: looked.append(1) or local(*of))
    reached, counts = 0, []
    for k, one in enumerate(q):
        near, T = one + away * direction(len(one), k), arm.forward(one)
        looked.clear()
        solution = arm.inverse(T, near)
        counts.append(len(looked))
        if solution is not None:
            reached += 1
            np.testing.assert_allclose(arm.forward(solution), T, atol=5e-9)
    assert reached >= found * COUNT
    assert np.median(counts) <= steps


@pytest.mark.parametrize("rig", ["ur5", "so101"])
def test_an_arm_that_is_not_redundant_comes_back_to_where_it_was(rig: str) -> None:
    chain = chain_of(rig)
    arm, q = RealtimeKinematics(chain), inside(chain)
    found = [arm.inverse(arm.forward(one), one + 0.02 * direction(len(one), k)) for k, one in enumerate(q)]
    off = np.array([np.inf if of is None else np.abs(of - one).max() for of, one in zip(found, q, strict=True)])
    assert np.mean(off < 1e-6) >= 0.97  # beside a singularity another branch may be nearer


def test_of_a_redundant_arm_s_solutions_the_nearest_is_found() -> None:
    """No motion that keeps the tip in place leads nearer to where the search began."""
    chain = chain_of("panda")
    arm, q = RealtimeKinematics(chain), inside(chain, 30)
    nearer = []
    for k, one in enumerate(q):
        near = one + 0.1 * direction(7, k)
        solution = arm.inverse(arm.forward(one), near)
        if solution is None or np.min(np.abs(solution - np.array(chain.limits))) < 1e-9:
            continue
        idle = np.linalg.svd(arm.jacobian(solution))[2][6]
        assert abs(idle @ (near - solution)) < 1e-4
        nearer.append(np.linalg.norm(solution - near) <= 0.1 + 1e-6)
    assert len(nearer) > 20
    assert np.mean(nearer) > 0.9  # beside a singularity idle motion may not lead to the nearest


def test_joints_stop_at_their_limits_and_others_make_up() -> None:
    chain = chain_of("panda")
    arm, q = RealtimeKinematics(chain), inside(chain, 40, seed=2)
    lower, upper = chain.limits
    at_limit = 0
    for k, one in enumerate(q):
        at = one.copy()
        at[2] = upper[2]
        near = at + 0.05 * direction(7, k)
        near[2] = upper[2] + 0.05  # further than the joint goes
        solution = arm.inverse(arm.forward(at), near)
        if solution is None:
            continue
        assert np.all((solution >= lower) & (solution <= upper))
        np.testing.assert_allclose(arm.forward(solution), arm.forward(at), atol=5e-9)
        at_limit += solution[2] == upper[2]
    assert at_limit > 10


def test_what_cannot_be_reached_is_none() -> None:
    chain = chain_of("ur5")
    arm, q = RealtimeKinematics(chain), inside(chain, 1)[0]
    T = arm.forward(q)
    T[:3, 3] *= 10.0
    assert arm.inverse(T, q) is None


def test_results_outlive_the_next_call() -> None:
    chain = chain_of("ur5")
    arm, (a, b) = RealtimeKinematics(chain), inside(chain, 2)
    T, J = arm.forward(a), arm.jacobian(a)
    kept = T.copy(), J.copy()
    arm.forward(b), arm.jacobian(b)
    assert np.array_equal(T, kept[0])
    assert np.array_equal(J, kept[1])


def test_a_link_that_no_joint_moves_is_refused() -> None:
    chain = chain_of("ur5")
    still = replace(chain.tips[0], joint=BASE, link="base_link")
    mechanism = Mechanism.__new__(type(chain))
    mechanism.__dict__.update({**chain.__dict__, "tips": (still,)})
    with pytest.raises(RobotError, match="link 'base_link': no joint moves this link"):
        RealtimeKinematics(mechanism)
