"""Estimate the noise of measurements and joint readings from the residuals (METHOD 8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import one_blas_thread, rms
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.whitening import Whitening, joint_noise

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from urdfcal.arrays import Bools, Floats, Ints
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


def with_noise(observations: Sequence[Observations], factors: Sequence[float]) -> Iterator[Floats]:
    """Give each kind's covariances (N, m, D, D) with its standard deviations times factors, one for each of them."""
    each = iter(factors)
    for observed in observations:
        factor = np.ones(observed.dimension)
        for of in observed.table.spread_of().values():
            factor[of.numbers] = next(each)
        yield np.outer(factor, factor) * observed.covariance


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
        One for each kind of measurement (one for each of its fields of standard deviations), and one for the joint
        readings, the last.
    """
    with one_blas_thread():
        likelihood, found, best = _likeliest(problem, fit)
        declared = np.array([*np.ones(len(found) - 1), max(problem.joint_sigma, _LEAST_JOINT) ** 2])
        sigma = 0.5 * np.sqrt(np.diag(np.linalg.inv(best.information + _VAGUE * np.eye(len(found)))))
        falls = []
        for k in range(len(found)):
            _, held = likelihood.maximise(np.where(np.arange(len(found)) == k, declared, found), hold=k)
            falls.append(max(0.0, 2.0 * (best.value - held.value)))
    names = [
        (of.noise, of.unit, rms(getattr(observed.table, name)))
        for observed in problem.observations
        for name, of in observed.table.spread_of().items()
    ]
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


def noise_factors(problem: Problem, fit: Solution) -> tuple[float, ...]:
    """Estimate noise as :func:`find_noise` does, without how surely it is known, at a third of the cost.

    Returns:
        For each kind of measurement its standard deviations over the declared ones; last that of joint readings. [rad]
    """
    with one_blas_thread():
        _, found, _ = _likeliest(problem, fit)
    return tuple(np.sqrt(found).tolist())


def _likeliest(problem: Problem, fit: Solution) -> tuple[_Likelihood, Floats, _LikelihoodValue]:
    """The likelihood of the variances at an estimate, the likeliest ones, and its value there."""
    parts: list[_Part] = []
    for observed, kept in zip(problem.observations, fit.kept, strict=True):
        parts.append(_Part.of(problem, fit, observed, kept, 1 + max((of.scaled_by.max() for of in parts), default=-1)))
    likelihood = _Likelihood(tuple(parts), *fit.parameters.prior_residuals(fit.state))
    start = np.array([*np.ones(1 + parts[-1].scaled_by.max()), max(problem.joint_sigma, _USUAL_JOINT) ** 2])
    return likelihood, *likelihood.maximise(start)


@dataclass(frozen=True, eq=False)
class _Part:
    """One kind of measurement at N poses, whitened by what is declared of it; zero where it is left out.

    Attributes:
        residual: (N, m D, 1).
        J: (N, m D, p) derivative by the parameters.
        joint: (N, m D, k) what 1 rad or m of each joint reading does.
        used: (N, m D) which numbers are not left out.
        scaled_by: (m D,) the number of the variance that each is scaled by.
    """

    residual: Floats
    J: Floats
    joint: Floats
    used: Bools
    scaled_by: Ints

    @classmethod
    def of(cls, problem: Problem, fit: Solution, observed: Observations, kept: Bools, first: int = 0) -> _Part:
        some = observed.even(_MOST_POSES)
        at = Tangent.at(problem, observed.at(some), fit.state, fit.parameters).linearise()
        N, m, D = at.residual.shape
        used = np.repeat(kept[some], D, axis=1)
        joint = joint_noise(at, problem.mechanism.reading_jacobian, 1.0)
        alone = Whitening.of(observed.covariance[some], joint[..., :0])
        columns = at.residual.reshape(N, m * D, 1), at.J.reshape(N, m * D, -1), joint
        residual, J, joint = (alone(of * used[..., None]) for of in columns)
        scaled_by = np.zeros(D, dtype=np.intp)
        for k, of in enumerate(observed.table.spread_of().values(), first):
            scaled_by[of.numbers] = k
        return cls(residual, J, joint, used, np.tile(scaled_by, m))


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
        least = np.append(np.full(len(variances) - 1, _LEAST_SHARE**2), _LEAST_JOINT**2)
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
        for part in self.parts:
            own = np.broadcast_to(variances[part.scaled_by, None, None], (*part.used.shape, 1, 1))
            W = Whitening.of(own, np.sqrt(variances[-1]) * part.joint)
            r, J = W(part.residual), W(part.J)
            whitened.append((W, r, J))
            H, g = H + np.einsum("nij,nik->jk", J, J), g + np.einsum("nij,ni->j", J, r[..., 0])
            logs = np.sum(part.used * np.log(variances[part.scaled_by])) + np.sum(np.log1p(W.strength))
            value -= 0.5 * float(logs + np.sum(r**2))
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        scaled = H * np.outer(scale, scale)
        covariance = np.linalg.pinv(scaled, hermitian=True) * np.outer(scale, scale)
        step = -covariance @ g
        value += 0.5 * float(g @ covariance @ g) - 0.5 * float(np.linalg.slogdet(H)[1])
        score, information = np.zeros(count), np.zeros((count, count))
        # A pose is whitened by R with R^2 = (1 + A A^T)^-1 = 1 - G G^T. The readings' share of its covariance then is
        # F F^T with F = R A, and that of a variance R M R, with M for the numbers that it scales.
        for part, (W, r, J) in zip(self.parts, whitened, strict=True):
            left, q = r + J @ step[:, None], count - 1
            F, share = W.shared(W.A), W.strength / (1.0 + W.strength)
            G = (W.A @ W.axes) / np.sqrt(1.0 + W.strength)[:, None]
            by_joint = np.swapaxes(F, 1, 2) @ J
            taken = np.sum((by_joint @ covariance) * by_joint)
            score[q] += 0.5 * (np.sum((np.swapaxes(F, 1, 2) @ left) ** 2) - np.sum(share) + taken)
            information[q, q] += 0.5 * np.sum(share**2)
            left, J, F = W.shared(left), W.shared(J), W.shared(F)
            each = {}
            for i in np.unique(part.scaled_by).tolist():
                mine = (part.used & (part.scaled_by == i))[..., None]
                of = mine * G
                free = np.sum(mine) - np.sum(of**2)
                score[i] += 0.5 * (np.sum(mine * left**2) - free + np.sum(mine * (J @ covariance) * J))
                each[i] = np.swapaxes(of, 1, 2) @ of
                information[i, i] += 0.5 * (free - np.sum(of**2))
                information[[i, q], [q, i]] += 0.5 * np.sum(mine * F**2)
            for i, a in each.items():
                for j, b in each.items():
                    information[i, j] += 0.5 * np.sum(a * b)
        return _LikelihoodValue(value, score, information)
