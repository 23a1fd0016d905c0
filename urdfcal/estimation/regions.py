"""Regions of the measured poses, to be left out as wholes: what an estimate is worth elsewhere (METHOD 13)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.problem import Problem

# As many as there are random folds: what is left to estimate from is as much.
_REGIONS = 5
_ROUNDS = 50


def joint_regions(problem: Problem) -> Ints:
    """Divide the session's poses (N,) into clusters of joint space; lengths count in shares of the arm's reach."""
    chain = problem.mechanism
    scale = np.array([1.0 / chain.reach if joint.prismatic else 1.0 for joint in chain.joints])
    return _clusters(problem, problem.readings.q * scale)


def tip_regions(problem: Problem) -> Ints:
    """Divide the session's poses (N,) into clusters of tip positions."""
    return _clusters(problem, tip_poses(problem.mechanism, problem.readings.q)[:, :3, 3])


def _clusters(problem: Problem, points: Floats) -> Ints:
    """Cluster points (N, k) by k-means from centres that are far from each other; no repeat is torn from another."""
    unit = problem.readings.unit
    used = np.unique(unit[problem.poses])
    means = np.array([points[unit == one].mean(axis=0) for one in used])
    count = min(_REGIONS, len(used))
    centres = means[[int(np.argmax(np.linalg.norm(means - means.mean(axis=0), axis=1)))]]
    while len(centres) < count:
        apart = np.linalg.norm(means[:, None] - centres, axis=2).min(axis=1)
        centres = np.vstack([centres, means[int(np.argmax(apart))]])
    for _ in range(_ROUNDS):
        nearest, before = np.linalg.norm(means[:, None] - centres, axis=2).argmin(axis=1), centres
        centres = np.array(
            [means[nearest == c].mean(axis=0) if np.any(nearest == c) else centres[c] for c in range(count)]
        )
        if np.array_equal(centres, before):
            break
    region = np.zeros(int(unit.max()) + 1, dtype=np.intp)
    region[used] = nearest
    result: Ints = region[unit]
    return result
