"""How well poses are predicted that an estimate has not seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.linearize import distances_per_unit, predict
from urdfcal.estimation.solver import deviations, refit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Geometry
    from urdfcal.estimation.solver import Solution

FOLDS = 5


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Predictions of left-out poses, each by an estimate from the other folds.

    Attributes:
        folds: number of folds.
        deviation: for each block of observations (N, m): whitened length of each sighting's residual.
        residual: for each block (N, m): length of the residual. [px or m]
        distance: for each block (N, m): how far the LED is off, for pixels across the ray. [m]
    """

    folds: int
    deviation: tuple[Floats, ...]
    residual: tuple[Floats, ...]
    distance: tuple[Floats, ...]


def loss(deviation: Sequence[Floats], blocks: Sequence[Observations]) -> float:
    """Mean of log(1 + deviation^2): a score that outliers cannot spoil, the lower the better."""
    parts = [np.log1p(d[block.valid] ** 2) for d, block in zip(deviation, blocks, strict=True)]
    return float(np.mean(np.concatenate(parts)))


def hold_out(table: Geometry, blocks: Sequence[Observations], fit: Solution, joint_sigma: float, seed: int) -> HeldOut:
    """Cross-validate an estimate over poses.

    Every fold is estimated anew without its poses, from the full estimate as a start: a start does not leak
    what is left out into where least squares arrives.

    Args:
        table: the arm's parameters.
        blocks: all observations.
        fit: the estimate from all of them; its parameters are estimated in every fold.
        joint_sigma: standard deviation of the joint readings. [rad or m]
        seed: of the division into folds.
    """
    count = min(FOLDS, len(np.unique(np.concatenate([block.pose for block in blocks]))))
    fold_of = _folds(blocks, count, seed)
    deviation, residual, distance = ([np.zeros(block.row.shape) for block in blocks] for _ in range(3))
    for fold in range(count):
        left_out = [of_block == fold for of_block in fold_of]
        training = [block.at(~out) for block, out in zip(blocks, left_out, strict=True)]
        kept = [keep[~out] for keep, out in zip(fit.kept, left_out, strict=True)]
        state = refit(table, training, kept, fit.state, fit.parameters, joint_sigma)
        for k, (block, out) in enumerate(zip(blocks, left_out, strict=True)):
            unseen = block.at(out)
            deviation[k][out] = deviations(table, unseen, state, fit.parameters, joint_sigma)
            residual[k][out] = np.linalg.norm(predict(table, unseen, state) - unseen.value, axis=-1)
            distance[k][out] = residual[k][out] * distances_per_unit(table, unseen, state)
    return HeldOut(count, tuple(deviation), tuple(residual), tuple(distance))


def _folds(blocks: Sequence[Observations], count: int, seed: int) -> list[Ints]:
    """The fold (N,) of each pose of each block: at random, or of an arm that moved stretches of time.

    Neighbouring frames are nearly the same pose: to predict one from the other is no test.
    """
    if blocks[0].trajectory is not None:
        time = blocks[0].trajectory.time
        fold = np.empty(len(time), dtype=np.intp)
        fold[np.argsort(time, kind="stable")] = np.arange(len(time)) * count // len(time)
        return [fold]
    poses = np.unique(np.concatenate([block.pose for block in blocks]))
    shuffled = np.random.default_rng(seed).permutation(poses)
    fold_of = dict(zip(shuffled.tolist(), np.arange(len(poses)) % count, strict=True))
    return [np.array([fold_of[pose] for pose in block.pose.tolist()]) for block in blocks]
