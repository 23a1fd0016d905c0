"""Least squares at a state: residuals, derivatives and normal equations, whitened by the noise (METHOD 9)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.whitening import JointNoise, Whitening, joint_noise

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.parameters import Parameters
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.robust import Weights
    from urdfcal.estimation.state import State

# Poses evaluated at a time: large enough to hide Python's overhead, small enough that a block's Jacobian
# (a few MB) stays in cache and memory does not grow with the session.
_BLOCK = 1024
# Within this distance (rad, m, focal lengths, s) derivatives are the same to one part in a few thousand: steps taken
# with them shrink by as much each, and the estimate is off by less than that share of a standard deviation.
_NEAR = 2e-4


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The normal equations at a state, the cost, and each measurement's whitened residual norm on its own."""

    H: Floats
    g: Floats
    cost: float
    norms: tuple[Floats, ...]


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """The residuals at a state, and what they do in its neighbourhood.

    Attributes:
        state: where.
        residual: for each kind (N, m, D).
        J: for each kind (N, m D, count) derivative, taken here or nearby.
        drift: how far (rad, m, focal lengths, s) the state may be from where J was taken.
        noise: for each kind, of the joint readings; taken where the descent began.
    """

    state: State
    residual: tuple[Floats, ...]
    J: tuple[Floats, ...]
    drift: float
    noise: tuple[JointNoise, ...]

    @property
    def norms(self) -> tuple[Floats, ...]:
        """For each kind (N, m): whitened residual norm of every measurement on its own."""
        return tuple(noise.norms(residual) for noise, residual in zip(self.noise, self.residual, strict=True))

    def at(self, poses: Sequence[Bools]) -> Neighbourhood:
        """Return that of some of each kind's poses (N,)."""
        return replace(
            self,
            residual=tuple(of[some] for of, some in zip(self.residual, poses, strict=True)),
            J=tuple(of[some] for of, some in zip(self.J, poses, strict=True)),
            noise=tuple(of.at(some) for of, some in zip(self.noise, poses, strict=True)),
        )


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """A problem and its parameters; evaluates states, knows nothing of the iteration."""

    problem: Problem
    parameters: Parameters

    def linearise(self, state: State, noise: tuple[JointNoise, ...] | None = None) -> Neighbourhood:
        """Find residuals, derivatives, and the noise that the joint readings give at a state."""
        problem, count, readings = self.problem, self.parameters.count, self.problem.mechanism.reading_jacobian
        residuals: list[Floats] = []
        derivatives: list[Floats] = []
        noises: list[JointNoise] = []
        for observed in problem.observations:
            tangent = Tangent.at(problem, observed, state, self.parameters)
            N, m, D = observed.value.shape
            residual, J = np.empty((N, m, D)), np.empty((N, m * D, count))
            joint = np.zeros((N, m * D, readings.shape[1] if problem.joint_sigma > 0.0 else 0))
            for poses in _chunks(N):
                at = tangent.linearise(poses)
                residual[poses], J[poses] = at.residual, at.J.reshape(-1, m * D, count)
                if noise is None and problem.joint_sigma > 0.0:
                    joint[poses] = joint_noise(at, readings, problem.joint_sigma)
            residuals.append(residual)
            derivatives.append(J)
            if noise is None:
                noises.append(JointNoise.of(observed.covariance, joint))
        return Neighbourhood(state, tuple(residuals), tuple(derivatives), 0.0, noise or tuple(noises))

    def step(self, at: Neighbourhood, step: Floats) -> Neighbourhood:
        """Find the residuals a step of the active parameters further; derivatives anew only where it leads far.

        Raises:
            CameraError: a lens that is none.
        """
        state = self.parameters.retract(at.state, step)
        scales = self.parameters.scales(at.state)[self.parameters.active]
        drift = at.drift + float(np.abs(step / scales).max(initial=0.0))
        if drift > _NEAR:
            return self.linearise(state, at.noise)
        residual = tuple(self.problem.residual(observed, state) for observed in self.problem.observations)
        return replace(at, state=state, residual=residual, drift=drift)

    def whitening(self, noise: Sequence[JointNoise], weights: Weights) -> tuple[Whitening, ...]:
        """Return for each kind what gives the residuals of whole poses unit variance."""
        return tuple(
            own.whitening(observed.covariance, weight)
            for observed, own, weight in zip(self.problem.observations, noise, weights, strict=True)
        )

    def evaluate(self, at: Neighbourhood, whitening: Sequence[Whitening]) -> NormalEquations:
        """Accumulate the normal equations over all poses, whole poses whitened."""
        r, J = self.parameters.prior_residuals(at.state)
        H, g, cost = J.T @ J, J.T @ r, float(r @ r)
        for residual, J, W in zip(at.residual, at.J, whitening, strict=True):
            N, m, D = residual.shape
            for poses in _chunks(N):
                whitened = W.at(poses)(np.concatenate([residual[poses].reshape(-1, m * D, 1), J[poses]], axis=2))
                whitened = whitened.reshape(-1, 1 + J.shape[2])
                r, J_poses = whitened[:, 0], whitened[:, 1:]
                H += J_poses.T @ J_poses
                g += J_poses.T @ r
                cost += float(r @ r)
        return NormalEquations(H, g, cost, at.norms)


def _chunks(count: int) -> Iterator[slice]:
    return (slice(first, min(first + _BLOCK, count)) for first in range(0, count, _BLOCK))
