"""Cross-validation: how well poses are predicted that an estimate has not seen (METHOD 13)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import one_blas_thread
from urdfcal.estimation.least_squares import LeastSquares
from urdfcal.estimation.solver import refit

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.least_squares import Neighbourhood
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Parameters
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution
    from urdfcal.estimation.state import State

FOLDS = 5
_RESAMPLES = 1000


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Predictions of left-out poses, each by an estimate from the other folds.

    Attributes:
        steps: (folds, count) from the full estimate's active parameters to those without each fold.
        norms: for each kind of measurement (N, m): whitened residual norm of each one.
        residual: for each kind (N, m): length of the residual. [unit of the measurement]
        distance: for each kind (N, m): how far the LED is off, for pixels across the ray. [m]
    """

    steps: Floats
    norms: tuple[Floats, ...]
    residual: tuple[Floats, ...]
    distance: tuple[Floats, ...]

    @property
    def folds(self) -> int:
        """Number of folds."""
        return len(self.steps)

    @property
    def spread(self) -> Floats:
        """Covariance (count, count) of the active parameters, from how far each fold moves them.

        Delete-a-group jackknife (Shao and Wu, Ann. Statist. 17, 1989): where errors are no noise, it shows how far the
        estimate depends on where was measured.
        """
        covariance: Floats = (self.folds - 1) / self.folds * self.steps.T @ self.steps
        return covariance


def loss(norms: Sequence[Floats], observations: Sequence[Observations]) -> float:
    """Return the mean of log(1 + norm^2): a score that outliers cannot spoil, the lower the better."""
    parts = [np.log1p(norm[observed.valid] ** 2) for norm, observed in zip(norms, observations, strict=True)]
    return float(np.mean(np.concatenate(parts)))


def random_folds(problem: Problem, seed: int) -> Ints:
    """Divide the session's poses (N,) into folds at random; what repeats a configuration stays with it."""
    readings = problem.readings
    distinct = len(np.unique(readings.unit[problem.poses]))
    return readings.motion.folds(readings.q, min(FOLDS, distinct), seed)


def hold_out(problem: Problem, fit: Solution, fold_of_pose: Ints) -> HeldOut:
    """Cross-validate an estimate over poses.

    Every fold is estimated anew without its poses, from the full estimate as a start: a start does not leak
    what is left out into where least squares arrives. A place that nothing else has touched is fitted to the poses that
    are left out, the arm is not, and the residuals are as much longer as it takes away from them.

    Args:
        problem: what was measured.
        fit: the estimate from all of it; its parameters are estimated in every fold.
        fold_of_pose: (poses of the session,) the fold that each is left out with.
    """
    observations = problem.observations
    norms, residual, distance = ([np.zeros(observed.row.shape) for observed in observations] for _ in range(3))
    steps = []
    with one_blas_thread():
        near = LeastSquares(problem, fit.parameters).linearise(fit.state)
    for out, state in _without_each(problem, fit, near, fold_of_pose):
        steps.append(fit.parameters.between(fit.state, state))
        unseen = problem.with_observations([of.at(left) for of, left in zip(observations, out, strict=True)])
        training = problem.with_observations([of.at(~left) for of, left in zip(observations, out, strict=True)])
        new, factors = _only_unseen(training, unseen, fit.parameters)
        if new.any():
            where = {int(k): "other poses tell it" for k in np.flatnonzero(~new & fit.parameters.active)}
            used = [keep[left] for keep, left in zip(fit.kept, out, strict=True)]
            own = fit.parameters.fixing(where)
            with one_blas_thread():
                there = LeastSquares(unseen, own).linearise(state)
            state = refit(unseen, used, there, own)
        for k, observed in enumerate(unseen.observations):
            left, factor, off = out[k], factors[k], unseen.residual(observed, state)
            # The joint readings' noise is that of the full estimate, from which a fold's hardly moves.
            norms[k][left] = factor * near.noise[k].at(left).norms(off)
            residual[k][left] = factor * np.linalg.norm(off, axis=-1)
            distance[k][left] = factor * unseen.off(observed, state, off)
    return HeldOut(np.array(steps), tuple(norms), tuple(residual), tuple(distance))


def _without_each(
    problem: Problem, fit: Solution, near: Neighbourhood, fold_of_pose: Ints
) -> Iterator[tuple[list[Bools], State]]:
    """For each fold which poses (N,) of each kind are in it, and the estimate without them."""
    observations = problem.observations
    fold_of = [fold_of_pose[observed.pose] for observed in observations]
    for fold in np.unique(fold_of_pose[problem.poses]):
        out = [of == fold for of in fold_of]
        training = problem.with_observations([of.at(~left) for of, left in zip(observations, out, strict=True)])
        kept = [keep[~left] for keep, left in zip(fit.kept, out, strict=True)]
        yield out, refit(training, kept, near.at([~left for left in out]), fit.parameters)


def _only_unseen(training: Problem, unseen: Problem, parameters: Parameters) -> tuple[Bools, list[Floats]]:
    """Find the unknowns, such as places, that only unseen measurements can tell.

    What they have fewer numbers of than unknowns stays where the full estimate has it: nothing can be told of it.

    Returns:
        Which of the parameters (P,) they are, and for each kind (N, m) the factor that makes up for fitting them.
    """
    new, factors = np.zeros(parameters.size, dtype=bool), [np.ones(of.row.shape) for of in unseen.observations]
    for name, key in {pair for of in unseen.observations for pair in of.table.own.items()}:
        columns = np.arange(parameters.size)[parameters.columns(key)]
        things = max(len(of.table.names[name]) for of in unseen.observations if name in of.table.own)
        each = len(columns) // things
        before, after = (sum(_numbers(of, name, things) for of in some.observations) for some in (training, unseen))
        lost = (before < each) & (after > each)
        new[columns] |= np.repeat(lost, each)
        longer = np.where(lost, np.sqrt(after / np.maximum(after - each, 1)), 1.0)
        factors = [
            factor * longer[of.index[name]] if name in of.index else factor
            for factor, of in zip(factors, unseen.observations, strict=True)
        ]
    return new, factors


def _numbers(observed: Observations, name: str, things: int) -> Ints:
    """How many numbers (things,) are measured of each thing that a key names."""
    if name not in observed.index:
        return np.zeros(things, dtype=np.intp)
    return observed.dimension * np.bincount(observed.index[name][observed.valid], minlength=things)


def rms_interval(
    observations: Sequence[Observations], kept: Sequence[Bools], distance: Sequence[Floats], unit: Ints, seed: int
) -> tuple[float, float]:
    """Bootstrap the 95 % interval of a root mean square by resampling whole units; see :func:`rms_samples`.

    Returns:
        2.5th and 97.5th percentile. [m]
    """
    low, high = np.percentile(rms_samples(observations, kept, distance, unit, seed), [2.5, 97.5])
    return float(low), float(high)


def rms_samples(
    observations: Sequence[Observations], kept: Sequence[Bools], distance: Sequence[Floats], unit: Ints, seed: int
) -> Floats:
    """Bootstrap a root mean square by resampling whole units: (1000,) values of it.

    Args:
        observations: the measurements, one for each kind.
        kept: for each kind (N, m): those that are no outliers.
        distance: for each kind (N, m): the values. [m]
        unit: (poses,) which unit a pose belongs to; errors of different units are independent.
        seed: of the samples.
    """
    squares, counts = _sums(observations, kept, distance, unit)
    seen = np.flatnonzero(counts)
    sample = np.random.default_rng(seed).choice(seen, (_RESAMPLES, len(seen)))
    result: Floats = np.sqrt(squares[sample].sum(axis=1) / counts[sample].sum(axis=1))
    return result


def region_interval(
    observations: Sequence[Observations], kept: Sequence[Bools], distance: Sequence[Floats], region: Ints
) -> tuple[float, float]:
    """Compute the 95 % interval of the rms in a further region, from those in some that were left out.

    The logarithms of the regions' rms are taken for normal; a further one scatters about their mean as they do.

    Args:
        observations: the measurements, one for each kind.
        kept: for each kind (N, m): those that are no outliers.
        distance: for each kind (N, m): the values. [m]
        region: (poses,) of each pose.

    Returns:
        Its ends, 0 and infinity where there is but one region. [m]
    """
    from scipy.special import stdtrit

    squares, counts = _sums(observations, kept, distance, region)
    logs = 0.5 * np.log(np.maximum(squares[counts > 0] / counts[counts > 0], 1e-30))
    if len(logs) < 2:
        return 0.0, float("inf")
    student = float(stdtrit(len(logs) - 1, 0.975))
    half = student * float(np.std(logs, ddof=1)) * np.sqrt(1.0 + 1.0 / len(logs))
    low, high = np.exp(np.mean(logs) + np.array([-half, half]))
    return float(low), float(high)


def _sums(
    observations: Sequence[Observations], kept: Sequence[Bools], distance: Sequence[Floats], unit: Ints
) -> tuple[Floats, Floats]:
    """The sum of squares in each unit, and how many values it is of."""
    squares, counts = np.zeros(unit.max() + 1), np.zeros(unit.max() + 1)
    for observed, used, values in zip(observations, kept, distance, strict=True):
        np.add.at(squares, unit[observed.pose], np.sum(np.where(used, values, 0.0) ** 2, axis=1))
        np.add.at(counts, unit[observed.pose], np.sum(used, axis=1))
    return squares, counts
