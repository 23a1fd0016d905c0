"""Cross-validation: how well poses are predicted that an estimate has not seen (METHOD 13)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.solver import refit, residual_norms

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution

FOLDS = 5


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Predictions of left-out poses, each by an estimate from the other folds.

    Attributes:
        folds: number of folds.
        norms: for each kind of measurement (N, m): whitened residual norm of each one.
        residual: for each kind (N, m): length of the residual. [unit of the measurement]
        distance: for each kind (N, m): how far the LED is off, for pixels across the ray. [m]
    """

    folds: int
    norms: tuple[Floats, ...]
    residual: tuple[Floats, ...]
    distance: tuple[Floats, ...]


def loss(norms: Sequence[Floats], observations: Sequence[Observations]) -> float:
    """Return the mean of log(1 + norm^2): a score that outliers cannot spoil, the lower the better."""
    parts = [np.log1p(norm[observed.valid] ** 2) for norm, observed in zip(norms, observations, strict=True)]
    return float(np.mean(np.concatenate(parts)))


def hold_out(problem: Problem, fit: Solution, seed: int) -> HeldOut:
    """Cross-validate an estimate over poses.

    Every fold is estimated anew without its poses, from the full estimate as a start: a start does not leak
    what is left out into where least squares arrives.

    Args:
        problem: what was measured.
        fit: the estimate from all of it; its parameters are estimated in every fold.
        seed: of the division into folds.
    """
    observations, poses = problem.observations, problem.poses
    count = min(FOLDS, len(poses))
    motion = max(observations, key=lambda observed: len(observed.pose)).readings.motion
    fold_of_pose = motion.folds(np.searchsorted(poses, poses), count, seed)
    fold_of = [fold_of_pose[np.searchsorted(poses, observed.pose)] for observed in observations]
    norms, residual, distance = ([np.zeros(observed.row.shape) for observed in observations] for _ in range(3))
    for fold in range(count):
        out = [of == fold for of in fold_of]
        training = problem.with_observations([of.at(~left) for of, left in zip(observations, out, strict=True)])
        unseen = problem.with_observations([of.at(left) for of, left in zip(observations, out, strict=True)])
        kept = [keep[~left] for keep, left in zip(fit.kept, out, strict=True)]
        state = refit(training, kept, fit.state, fit.parameters)
        for k, norm in enumerate(residual_norms(unseen, state, fit.parameters)):
            left, observed = out[k], unseen.observations[k]
            norms[k][left] = norm
            residual[k][left] = np.linalg.norm(unseen.residual(observed, state), axis=-1)
            distance[k][left] = residual[k][left] * unseen.metres_per_unit(observed, state)
    return HeldOut(count, tuple(norms), tuple(residual), tuple(distance))
