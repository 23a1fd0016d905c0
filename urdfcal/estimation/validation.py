"""How well poses are predicted that an estimate has not seen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.residuals import distances_per_unit, predict
from urdfcal.estimation.solver import deviations, refit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Bools, Floats
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
    poses = np.unique(np.concatenate([block.pose for block in blocks]))
    count = min(FOLDS, len(poses))
    fold_of = dict(
        zip(np.random.default_rng(seed).permutation(poses).tolist(), np.arange(len(poses)) % count, strict=True)
    )
    deviation, residual, distance = ([np.zeros(block.row.shape) for block in blocks] for _ in range(3))
    for fold in range(count):
        left_out = [np.array([fold_of[pose] == fold for pose in block.pose.tolist()]) for block in blocks]
        training = [_at(block, ~out) for block, out in zip(blocks, left_out, strict=True)]
        kept = [keep[~out] for keep, out in zip(fit.kept, left_out, strict=True)]
        state = refit(table, training, kept, fit.state, fit.parameters, joint_sigma)
        for k, (block, out) in enumerate(zip(blocks, left_out, strict=True)):
            unseen = _at(block, out)
            deviation[k][out] = deviations(table, unseen, state, fit.parameters, joint_sigma)
            residual[k][out] = np.linalg.norm(predict(table, unseen, state) - unseen.value, axis=-1)
            distance[k][out] = residual[k][out] * distances_per_unit(table, unseen, state)
    return HeldOut(count, tuple(deviation), tuple(residual), tuple(distance))


def _at(block: Observations, poses: Bools) -> Observations:
    """The observations of some of the poses."""
    return replace(
        block,
        **{name: getattr(block, name)[poses] for name in ("pose", "q", "row", "led", "camera", "value", "covariance")},
    )
