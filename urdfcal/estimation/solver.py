"""Robust nonlinear least squares: Levenberg-Marquardt on normal equations accumulated over poses.

Residuals are whitened by the noise of the sightings and of the joint readings, a Huber weight tames each
LED sighting, and what is left far outside the noise is taken out at the end (DESIGN section 6).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
import threadpoolctl

from urdfcal.errors import CalibrationError, CameraError
from urdfcal.estimation.linearize import Tangent, predict

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.linearize import Linearisation
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Geometry, Parameters
    from urdfcal.estimation.state import State

# Poses evaluated at a time: large enough to hide Python's overhead, small enough that a block's Jacobian
# (a few MB) stays in cache and memory does not grow with the session.
_BLOCK = 1024
# Ordinary sessions settle in ten; lenses that start a thousand pixels off need a hundred along a bent valley.
_MAX_ITERATIONS = 300
_MAX_CUTS = 5
# A session of more poses than this is first solved on an even selection of some: the rest then need few passes.
_MANY, _SOME = 1000, 300
# Within this distance (rad, m, focal lengths, s) derivatives are the same to one part in a few thousand: steps taken
# with them shrink by as much each, and the estimate is off by less than that share of a standard deviation.
_NEAR = 2e-4
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e16
# A step of this many standard deviations of the estimate is no step; the coarse one is for cross-validation.
_CONVERGED, _CONVERGED_COARSE = 1e-6, 1e-2
# Weights are settled when the step after they were renewed moves sightings by less than this share of their standard
# deviation, root mean square: it changes no verdict on an outlier.
_SETTLED = 0.05
# Rounding of a cost that no longer falls.
_COST_ROUNDING = 1e-10
# Lengths of a whitened residual, pixels (2) and points (3): the median, what 5 % exceed, and one in a billion. Beyond
# the second a sighting's pull stops growing, which costs clean data less than 5 % efficiency; beyond the third it is
# an outlier: wrong LEDs are tens of sigmas away, and measured data (irb120_liaowu) have honest tails to six. Square
# roots of chi-square quantiles, as numbers because scipy.special costs every command a fifth of a second.
_MEDIAN = {2: 1.1774100225154749, 3: 1.5381722544550522}
_HUBER = {2: 2.447746830680816, 3: 2.795483482915107}
_OUTLIER = {2: 6.4378980788680416, 3: 6.696362843407039}
# A chi-square this many of its standard deviations above expectation is a misfit; widening by less makes intervals
# too wide on clean data (97 instead of 95 % at twenty poses).
_CERTAIN = 3.0
_REJECTED = 1e-12

Weights: TypeAlias = "Sequence[Floats]"
"""For each block of observations (N, m): 1 counts fully, less inflates the sighting's covariance by 1 / weight."""


class Progress(Protocol):
    """Called after every iteration with the cost so far."""

    def __call__(self, iteration: int, cost: float) -> None:
        """Take note of an accepted step."""


@dataclass(frozen=True, eq=False)
class Iteration:
    """One accepted step.

    Attributes:
        cost: weighted sum of squared whitened residuals, priors included.
        damping: Levenberg-Marquardt's lambda.
        step: its length in standard deviations of the estimate.
        state: after the step.
    """

    cost: float
    damping: float
    step: float
    state: State


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the solver arrived.

    Attributes:
        state: the estimate.
        parameters: what was estimated.
        information: (count, count) J^T J of the whitened residuals and the priors, outliers left out.
        deviation: for each block of observations (N, m): whitened length of the residual of each sighting.
        outlier: for each block (N, m): taken out of the fit.
        kept: for each block (N, m): the sightings the fit rests on.
        cost: chi-square of residuals and priors, outliers left out.
        observations: scalar measurements used.
        history: accepted steps.
        converged: whether the last step was small.
    """

    state: State
    parameters: Parameters
    information: Floats
    deviation: tuple[Floats, ...]
    outlier: tuple[Bools, ...]
    kept: tuple[Bools, ...]
    cost: float
    observations: int
    history: tuple[Iteration, ...]
    converged: bool

    @property
    def reduced_chi2(self) -> float:
        """Chi-square per degree of freedom, priors counted as measurements; about 1 when the noise is as declared."""
        return self.cost / self.freedom if self.freedom > 0 else float("nan")

    @property
    def freedom(self) -> int:
        """Degrees of freedom: measured numbers and priors less parameters."""
        priors = int(np.count_nonzero(np.isfinite(self.parameters.prior) & self.parameters.active))
        return self.observations + priors + len(self.parameters.distances) - self.parameters.count

    @property
    def covariance(self) -> Floats:
        """(count, count) of the active parameters, widened where the misfit exceeds the declared noise for certain."""
        scale = 1.0 / np.sqrt(np.diag(self.information))
        inverse: Floats = np.linalg.inv(self.information * np.outer(scale, scale)) * np.outer(scale, scale)
        chance = 1.0 + _CERTAIN * np.sqrt(2.0 / max(self.freedom, 1))
        return inverse * (self.reduced_chi2 if self.reduced_chi2 > chance else 1.0)


def solve(
    table: Geometry,
    blocks: Sequence[Observations],
    start: State,
    parameters: Parameters,
    joint_sigma: float,
    progress: Progress | None = None,
) -> Solution:
    """Estimate the active parameters from a start that is near enough for Gauss-Newton.

    First Huber weights that follow a robust scale of the residuals (the nominal arm is many sigmas off), of thousands
    of poses on an even selection; once they have settled, outliers are cut and least squares on the rest of all poses
    finishes, until the cut stays the same.

    Args:
        table: the arm's parameters.
        blocks: what was measured.
        start: first state.
        parameters: what to estimate, with priors.
        joint_sigma: standard deviation of the joint readings. [rad or m]
        progress: called after every step.

    Raises:
        CalibrationError: the start puts an LED behind a camera.
    """
    with threadpoolctl.threadpool_limits(1, user_api="blas"):  # two threads are slower at these sizes
        problem = _Problem(table, tuple(blocks), parameters, joint_sigma)
        robust = problem
        if max(len(block.pose) for block in blocks) > _MANY:
            robust = replace(problem, blocks=tuple(block.at(block.spread(_SOME)) for block in blocks))
        first, ones = robust.survey(start), _ones(robust.blocks)
        descent = _descend(robust, first, ones, _Huber(), _FIRST_DAMPING, robust.settled, progress)
        history, survey = list(descent.history), descent.survey
        # Where the derivatives are no longer those of the start, the joint readings' noise may not be, either.
        if robust is not problem or survey.J is not first.J:
            survey = problem.survey(descent.state)
        for _ in range(_MAX_CUTS):
            outlier = _outliers(problem.blocks, survey.deviation)
            kept = [np.where(cut, _REJECTED, 1.0) for cut in outlier]
            damping = min(descent.damping, _FIRST_DAMPING)
            descent = _descend(problem, survey, kept, _same_weights, damping, _CONVERGED, progress)
            survey = descent.survey
            history += descent.history
            again = _outliers(problem.blocks, survey.deviation)
            if all(np.array_equal(a, b) for a, b in zip(outlier, again, strict=True)):
                break
    left = sum(block.dimension * int(np.sum(block.valid & ~cut)) for block, cut in zip(blocks, outlier, strict=True))
    return Solution(
        state=descent.state,
        parameters=parameters,
        information=descent.at.H,
        deviation=descent.at.deviation,
        outlier=tuple(outlier),
        kept=tuple(block.valid & ~cut for block, cut in zip(blocks, outlier, strict=True)),
        cost=descent.at.cost,
        observations=left,
        history=tuple(history),
        converged=descent.converged,
    )


def refit(
    table: Geometry,
    blocks: Sequence[Observations],
    kept: Sequence[Bools],
    start: State,
    parameters: Parameters,
    joint_sigma: float,
) -> State:
    """Estimate from some of the sightings, near a start that is already good.

    Args:
        table: the arm's parameters.
        blocks: what was measured.
        kept: for each block (N, m): the sightings that count.
        start: first state.
        parameters: what to estimate, with priors.
        joint_sigma: standard deviation of the joint readings. [rad or m]
    """
    weights = [np.where(keep, 1.0, _REJECTED) for keep in kept]
    with threadpoolctl.threadpool_limits(1, user_api="blas"):
        problem = _Problem(table, tuple(blocks), parameters, joint_sigma)
        survey = problem.survey(start)
        return _descend(problem, survey, weights, _same_weights, _FIRST_DAMPING, _CONVERGED_COARSE, None).state


def deviations(
    table: Geometry, block: Observations, state: State, parameters: Parameters, joint_sigma: float
) -> Floats:
    """Whitened length (N, m) of every sighting's residual at a state: its noise and its joint readings' count."""
    problem = _Problem(table, (block,), parameters, joint_sigma)
    return problem.survey(state).deviation[0]


@dataclass(frozen=True, eq=False)
class _Evaluation:
    """The normal equations at a state, the cost, and each sighting's deviation on its own."""

    H: Floats
    g: Floats
    cost: float
    deviation: tuple[Floats, ...]


@dataclass(frozen=True, eq=False)
class _Noise:
    """What the joint readings' noise does to a block, and what gives each sighting alone unit variance.

    Attributes:
        joint: (N, mD, mD) covariance of whole poses from joint readings.
        marginal: (N, m, D, D) whitening of each sighting by its own and its share of the joint noise.
    """

    joint: Floats
    marginal: Floats


@dataclass(frozen=True, eq=False)
class _Survey:
    """The residuals at a state, and what they do in its neighbourhood.

    Attributes:
        state: where.
        residual: for each block (N, m, D).
        J: for each block (N, m D, count) derivative, taken here or nearby.
        drift: how far (rad, m, focal lengths, s) the state may be from where J was taken.
        noise: for each block, of the joint readings; taken where the descent began.
    """

    state: State
    residual: tuple[Floats, ...]
    J: tuple[Floats, ...]
    drift: float
    noise: tuple[_Noise, ...]

    @property
    def deviation(self) -> tuple[Floats, ...]:
        """For each block (N, m): whitened length of every sighting's residual, on its own."""
        deviations = []
        for residual, noise in zip(self.residual, self.noise, strict=True):
            own = (noise.marginal @ residual[..., None])[..., 0]
            deviations.append(np.sqrt(np.einsum("nmd,nmd->nm", own, own)))
        return tuple(deviations)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Observations, parameters and noise; evaluates states, knows nothing of the iteration."""

    table: Geometry
    blocks: tuple[Observations, ...]
    parameters: Parameters
    joint_sigma: float

    @property
    def settled(self) -> float:
        """The step below which weights are settled."""
        return _SETTLED * float(np.sqrt(sum(block.count for block in self.blocks)))

    def survey(self, state: State) -> _Survey:
        """Find residuals, derivatives, and the noise that the joint readings give at a state."""
        return self._linearise(state, None)

    def step(self, survey: _Survey, step: Floats) -> _Survey:
        """Find the residuals a step of the active parameters further; derivatives anew only where it leads far.

        Raises:
            CameraError: a lens that is none.
        """
        state = self.parameters.move(survey.state, step)
        scales = self.parameters.scales(survey.state)[self.parameters.active]
        drift = survey.drift + float(np.abs(step / scales).max(initial=0.0))
        if drift > _NEAR:
            return self._linearise(state, survey.noise)
        residual = tuple(predict(self.table, block, state) - block.value for block in self.blocks)
        return replace(survey, state=state, residual=residual, drift=drift)

    def whitening(self, noise: Sequence[_Noise], weights: Weights) -> tuple[Floats, ...]:
        """What gives the residuals of whole poses unit variance, for each block (N, mD, mD)."""
        return tuple(
            _whitening(block.covariance, own.joint, weight)
            for block, own, weight in zip(self.blocks, noise, weights, strict=True)
        )

    def evaluate(self, survey: _Survey, whitening: Sequence[Floats]) -> _Evaluation:
        """Accumulate the normal equations over all poses, whole poses whitened (N, mD, mD)."""
        r, J = self.parameters.prior_residuals(survey.state)
        H, g, cost = J.T @ J, J.T @ r, float(r @ r)
        for residual, J, W in zip(survey.residual, survey.J, whitening, strict=True):
            N, m, D = residual.shape
            for poses in _chunks(N):
                r = (W[poses] @ residual[poses].reshape(-1, m * D, 1)).ravel()
                J_poses = (W[poses] @ J[poses]).reshape(len(r), -1)
                H += J_poses.T @ J_poses
                g += J_poses.T @ r
                cost += float(r @ r)
        return _Evaluation(H, g, cost, survey.deviation)

    def _linearise(self, state: State, noise: tuple[_Noise, ...] | None) -> _Survey:
        residuals: list[Floats] = []
        derivatives: list[Floats] = []
        noises: list[_Noise] = []
        for block in self.blocks:
            tangent = Tangent.at(self.table, block, state, self.parameters)
            N, m, D = block.value.shape
            residual, J = np.empty((N, m, D)), np.empty((N, m * D, self.parameters.count))
            joint = np.zeros((N, m * D, m * D))
            for poses in _chunks(N):
                at = tangent.linearise(poses)
                residual[poses], J[poses] = at.residual, at.J.reshape(-1, m * D, self.parameters.count)
                if noise is None and self.joint_sigma > 0.0:
                    joint[poses] = self._joint_noise(at)
            residuals.append(residual)
            derivatives.append(J)
            if noise is None:
                noises.append(_Noise(joint, _marginal_whitening(block.covariance, joint)))
        return _Survey(state, tuple(residuals), tuple(derivatives), 0.0, noise or tuple(noises))

    def _joint_noise(self, at: Linearisation) -> Floats:
        N, m, D = at.residual.shape
        # A mimic joint has no encoder: it errs with its master.
        J_q = at.by_joints(self.table.chain).reshape(N * m * D, -1) @ self.table.chain.reading_jacobian
        J_q = self.joint_sigma * J_q.reshape(N, m * D, -1)
        covariance: Floats = J_q @ np.swapaxes(J_q, -1, -2)
        return covariance


def _whitening(covariance: Floats, joint: Floats, weight: Floats) -> Floats:
    """Inverse Cholesky factors of whole poses: their sightings' noise over the weights, and the joint readings'."""
    N, m, D, _ = covariance.shape
    pose = joint.reshape(N, m, D, m, D).copy()
    each = np.arange(m)
    pose[:, each, :, each, :] += np.moveaxis(covariance / weight[..., None, None], 1, 0)
    W: Floats = np.linalg.inv(np.linalg.cholesky(pose.reshape(N, m * D, m * D)))
    return W


def _marginal_whitening(covariance: Floats, joint: Floats) -> Floats:
    N, m, D, _ = covariance.shape
    each = np.arange(m)
    own = covariance + np.moveaxis(joint.reshape(N, m, D, m, D)[:, each, :, each, :], 0, 1)
    W: Floats = np.linalg.inv(np.linalg.cholesky(own))
    return W


@dataclass(frozen=True, eq=False)
class _Descent:
    """Where a descent ended.

    Attributes:
        survey: of its last state.
        at: the normal equations there.
        damping: Levenberg-Marquardt's lambda.
        history: accepted steps.
        converged: whether the last step was small.
    """

    survey: _Survey
    at: _Evaluation
    damping: float
    history: tuple[Iteration, ...]
    converged: bool

    @property
    def state(self) -> State:
        return self.survey.state


def _descend(
    problem: _Problem,
    survey: _Survey,
    weights: Weights,
    renew: Callable[[Sequence[Observations], _Evaluation, Weights], Weights],
    damping: float,
    tolerance: float,
    progress: Progress | None,
) -> _Descent:
    """Levenberg-Marquardt until steps are shorter than ``tolerance`` and stay so when weights are renewed.

    Damping follows the gain, the cost's fall over what the linear model promised (Nielsen, IMM-REP-1999-05). The
    joint readings' noise is that of the survey: a start may be another arm, but from there it hardly moves.
    """
    whitening = problem.whitening(survey.noise, weights)
    at = problem.evaluate(survey, whitening)
    if not np.isfinite(at.cost):
        raise CalibrationError(
            "the start puts an LED behind a camera",
            remedy="Check the order of the cameras, where those that ride on the robot sit, the units of the joint "
            "readings and the tip link.",
        )
    history: list[Iteration] = []
    growth, length, ahead, fresh = 2.0, np.inf, np.inf, False
    while damping < _MOST_DAMPING and len(history) < _MAX_ITERATIONS:
        if ahead < tolerance or not history:
            renewed = renew(problem.blocks, at, weights)
            same = all(np.array_equal(a, b) for a, b in zip(renewed, weights, strict=True))
            if ahead < tolerance and (same or fresh):
                break
            if not same:
                weights, whitening = renewed, problem.whitening(survey.noise, renewed)
                at = problem.evaluate(survey, whitening)
            length, fresh = np.inf, True
        step = _damped_step(at, damping)
        promised = -float(step @ (2.0 * at.g + at.H @ step))
        try:
            candidate = problem.step(survey, step)
            new = problem.evaluate(candidate, whitening)
        except CameraError:  # a trial lens that is none
            damping, growth = damping * growth, 2.0 * growth
            continue
        # NaN (an LED behind a camera) is no improvement either.
        if not new.cost <= at.cost * (1.0 + _COST_ROUNDING) + _COST_ROUNDING:
            damping, growth = damping * growth, 2.0 * growth
            continue
        before, length = length, float(np.sqrt(max(float(step @ at.H @ step), 0.0)))
        ratio = min(length / before, 0.5) if before < np.inf else 0.5
        ahead = length * ratio / (1.0 - ratio)  # what is left if every step shrinks as this one did
        fresh = fresh and ahead < tolerance
        gain = (at.cost - new.cost) / promised if promised > 0.0 else 1.0
        damping, growth = damping * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
        survey, at = candidate, new
        history.append(Iteration(at.cost, damping, length, survey.state))
        if progress is not None:
            progress(len(history), at.cost)
    return _Descent(survey, at, damping, tuple(history), ahead < tolerance)


def _damped_step(at: _Evaluation, damping: float) -> Floats:
    """Solve the normal equations in column-scaled form, so that metres and radians weigh alike."""
    diagonal = np.diag(at.H)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    H = at.H * np.outer(scale, scale)
    step: Floats = -scale * np.linalg.solve(H + damping * np.eye(len(H)), scale * at.g)
    return step


def _ones(blocks: Sequence[Observations]) -> Weights:
    return [np.ones(block.row.shape) for block in blocks]


def _same_weights(blocks: Sequence[Observations], at: _Evaluation, weights: Weights) -> Weights:
    del blocks, at
    return weights


class _Huber:
    """Huber weights in units of the residuals' robust scale.

    Within a descent the scale may only shrink: else one bad step raises it, outliers pull harder, and it rises again.
    """

    def __init__(self) -> None:
        self._scales: dict[int, float] = {}

    def __call__(self, blocks: Sequence[Observations], at: _Evaluation, weights: Weights) -> Weights:
        """Give sightings beyond the limit the weight limit / deviation."""
        del weights
        renewed = []
        for i, (block, deviation) in enumerate(zip(blocks, at.deviation, strict=True)):
            self._scales[i] = min(_scale(block, deviation), self._scales.get(i, np.inf))
            limit = _HUBER[block.dimension] * self._scales[i]
            renewed.append(limit / np.maximum(deviation, limit))
        return renewed


def _outliers(blocks: Sequence[Observations], deviations: Sequence[Floats]) -> list[Bools]:
    return [
        (deviation > _OUTLIER[block.dimension] * _scale(block, deviation)) & block.valid
        for block, deviation in zip(blocks, deviations, strict=True)
    ]


def _scale(block: Observations, deviation: Floats) -> float:
    """How many times longer than the declared noise's the median residual is, at least 1."""
    return max(1.0, float(np.median(deviation[block.valid])) / _MEDIAN[block.dimension])


def _chunks(count: int) -> Iterator[slice]:
    return (slice(first, min(first + _BLOCK, count)) for first in range(0, count, _BLOCK))
