"""Estimate the noise of measurements and joint readings from the residuals (METHOD 8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import one_blas_thread, rms
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.whitening import Whitening, joint_noise

if TYPE_CHECKING:
    from collections.abc import Collection

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution

# Of thousands of poses an even selection tells the noise to a few per cent.
_MOST_POSES = 300
_ROUNDS = 30
# Logarithms of variances that change by less in a round have settled; a round may change them by this at most.
_SETTLED, _LARGEST_STEP = 1e-3, 1.5
# Joint readings err by something: below this nothing is told from zero. Where nothing is said, a good encoder's. [rad]
_LEAST_JOINT, _USUAL_JOINT = 1e-6, 1e-4
# Measurements without any noise, as simulated ones may be, count as a thousandth of what is declared.
_LEAST_SHARE = 1e-3
# Standard deviation of the logarithm up to which a noise counts as known.
_KNOWN = 0.5
# Information on a variance's logarithm where the residuals say nothing, as of joints that move nothing that is seen: a
# standard deviation of one decade of the noise. Ten poses say a hundred times more.
_VAGUE = (2.0 * np.log(10.0)) ** -2
# Fall of twice the log-likelihood that contradicts what is declared: chance 1e-4 (chi-square, one degree of freedom).
_CONTRADICTED = 15.1


@dataclass(frozen=True)
class FoundNoise:
    """The standard deviation of one kind of reading, as declared and as found.

    Attributes:
        name: key of ``noise`` in the session.
        unit: px, m, or rad for joint readings.
        declared: as the session says; None where it says nothing.
        found: from the residuals.
        relative_sigma: standard deviation of the logarithm of ``found``.
        chi2: by how much twice the log-likelihood falls if the declared one is taken for it; 0 where nothing is said.
    """

    name: str
    unit: str
    declared: float | None
    found: float
    relative_sigma: float
    chi2: float

    @property
    def known(self) -> bool:
        """Whether the residuals tell it, to half of itself or so."""
        return self.relative_sigma < _KNOWN

    @property
    def ratio(self) -> float:
        """Declared over found; 1 where nothing is declared, or the residuals do not contradict it."""
        if self.declared is None or self.chi2 < _CONTRADICTED:
            return 1.0
        return self.declared / self.found


def find_noise(problem: Problem, fit: Solution, undeclared: Collection[str] = ()) -> tuple[FoundNoise, ...]:
    """Estimate variance components by restricted maximum likelihood, on the derivatives at an estimate.

    The covariance of a pose's measurements is ``sum_k v_k C_k + v_q J_q J_q^T``: as declared for each kind, times its
    factor, and what the joint readings' noise does to it, which grows with the lever arm and moves all measurements of
    a pose together. Fisher scoring on the logarithms (Patterson and Thompson, Biometrika 58, 1971).

    Args:
        problem: what was measured.
        fit: an estimate; its outliers have no part.
        undeclared: keys of ``noise``, joint perhaps among them, of which the session says nothing.

    Returns:
        One for each kind of measurement, and one for the joint readings, the last.
    """
    with one_blas_thread():
        parts = [
            _Part.of(problem, fit, observed, kept)
            for observed, kept in zip(problem.observations, fit.kept, strict=True)
        ]
        likelihood = _Likelihood(tuple(parts), *fit.parameters.prior_residuals(fit.state))
        declared = np.array([*np.ones(len(parts)), max(problem.joint_sigma, _LEAST_JOINT) ** 2])
        start = np.array([*np.ones(len(parts)), max(problem.joint_sigma, _USUAL_JOINT) ** 2])
        found, best = likelihood.maximise(start)
        sigma = 0.5 * np.sqrt(np.diag(np.linalg.inv(best.information + _VAGUE * np.eye(len(found)))))
        falls = []
        for k in range(len(found)):
            _, held = likelihood.maximise(np.where(np.arange(len(found)) == k, declared, found), hold=k)
            falls.append(max(0.0, 2.0 * (best.value - held.value)))
    names = [(of.table.noise, of.table.unit, rms(of.table.sigma)) for of in problem.observations]
    names.append(("joint", "rad", 1.0))
    return tuple(
        FoundNoise(
            name,
            unit,
            None if name in undeclared else problem.joint_sigma if name == "joint" else usual,
            usual * float(np.sqrt(found[k])),
            float(sigma[k]),
            0.0 if name in undeclared else falls[k],
        )
        for k, (name, unit, usual) in enumerate(names)
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """One kind of measurement at N poses, whitened by what is declared of it; zero where it is left out.

    Attributes:
        residual: (N, m D, 1).
        J: (N, m D, p) derivative by the parameters.
        joint: (N, m D, k) what 1 rad or m of each joint reading does.
        count: of numbers that are not left out.
    """

    residual: Floats
    J: Floats
    joint: Floats
    count: int

    @classmethod
    def of(cls, problem: Problem, fit: Solution, observed: Observations, kept: Bools) -> _Part:
        some = observed.even(_MOST_POSES)
        at = Tangent.at(problem, observed.at(some), fit.state, fit.parameters).linearise()
        N, m, D = at.residual.shape
        used = np.repeat(kept[some], D, axis=1)[..., None]
        joint = joint_noise(at, problem.arm.chain.reading_jacobian, 1.0)
        alone = Whitening.of(observed.covariance[some], joint[..., :0])
        columns = at.residual.reshape(N, m * D, 1), at.J.reshape(N, m * D, -1), joint
        residual, J, joint = (alone(of * used) for of in columns)
        return cls(residual, J, joint, int(np.count_nonzero(used)))


@dataclass(frozen=True, eq=False)
class _LikelihoodValue:
    """The restricted log-likelihood, its derivative by the variances' logarithms, and its Fisher information."""

    value: float
    score: Floats
    information: Floats


@dataclass(frozen=True, eq=False)
class _Likelihood:
    parts: tuple[_Part, ...]
    r_prior: Floats
    J_prior: Floats

    def maximise(self, variances: Floats, hold: int | None = None) -> tuple[Floats, _LikelihoodValue]:
        """Return the likeliest variances, one of them held, and the likelihood there."""
        free = np.arange(len(variances)) != hold
        least = np.append(np.full(len(self.parts), _LEAST_SHARE**2), _LEAST_JOINT**2)
        for _ in range(_ROUNDS):
            at = self.at(variances)
            information = at.information[np.ix_(free, free)]
            damped = information + _VAGUE * np.eye(len(information))
            step = np.zeros(len(variances))
            step[free] = np.clip(np.linalg.solve(damped, at.score[free]), -_LARGEST_STEP, _LARGEST_STEP)
            moved = np.maximum(variances * np.exp(step), least)
            change = np.abs(np.log(moved / variances)).max()
            variances = moved
            if change < _SETTLED:
                break
        return variances, self.at(variances)

    def at(self, variances: Floats) -> _LikelihoodValue:
        """Evaluate."""
        count = len(variances)
        H, g = self.J_prior.T @ self.J_prior, self.J_prior.T @ self.r_prior
        whitened, value = [], -0.5 * float(self.r_prior @ self.r_prior)
        for k, part in enumerate(self.parts):
            own = np.broadcast_to(variances[k] * np.eye(1), (*part.residual.shape[:2], 1, 1))
            W = Whitening.of(own, np.sqrt(variances[-1]) * part.joint)
            r, J, F = W(part.residual), W(part.J), W.shared(W.A)
            whitened.append((r, J, F, W.strength / (1.0 + W.strength)))
            H, g = H + np.einsum("nij,nik->jk", J, J), g + np.einsum("nij,ni->j", J, r[..., 0])
            value -= 0.5 * (part.count * np.log(variances[k]) + np.sum(np.log1p(W.strength)) + np.sum(r**2))
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        scaled = H * np.outer(scale, scale)
        covariance = np.linalg.pinv(scaled, hermitian=True) * np.outer(scale, scale)
        step = -covariance @ g
        value += 0.5 * float(g @ covariance @ g) - 0.5 * float(np.linalg.slogdet(H)[1])
        score, information = np.zeros(count), np.zeros((count, count))
        # A pose's covariance V is whitened to 1: what the readings' share of it is there, F F^T, its own is not.
        for k, (part, (r, J, F, share)) in enumerate(zip(self.parts, whitened, strict=True)):
            left, q = r + J @ step[:, None], count - 1
            by_joint = np.swapaxes(F, 1, 2) @ J
            taken = np.array([np.sum((of @ covariance) * of) for of in (J, by_joint)])
            explained = np.array([np.sum(left**2), np.sum((np.swapaxes(F, 1, 2) @ left) ** 2)])
            trace = np.array([part.count, np.sum(share)])
            of_whole, of_joint = 0.5 * (explained - trace + taken)
            score[[k, q]] += of_whole - of_joint, of_joint
            squared, mixed = np.sum(share**2), np.sum(share - share**2)
            information[k, k] += 0.5 * (part.count - 2.0 * trace[1] + squared)
            information[[k, q], [q, k]] += 0.5 * mixed
            information[q, q] += 0.5 * squared
        return _LikelihoodValue(value, score, information)
