"""Estimate the noise of measurements and joint readings from the residuals (METHOD 8)."""

from __future__ import annotations

from dataclasses import dataclass
from math import log
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
# Information on the logarithm of a variance that is meant: its standard deviation is known to a factor of 1.5. Of
# 20 poses of a ur5 with a board, seen to 0.01 px, joint models were found in 4 of 5 that had none, the readings' noise
# having come out as none.
_MEANT = (2.0 * np.log(1.5)) ** -2
# Fall of twice the log-likelihood that contradicts what is declared: chance 1e-4 (chi-square, one degree of freedom).
_CONTRADICTED = 15.1
# No LED is found so badly, no ball touched, and no probe turned: what is of that size is a mistake in the session. The
# board of a webcam's hand-eye set is seen to 0.02 rad, wrong quaternions miss by 0.5 to 2.
_MOST = {"px": 20.0, "m": 0.05, "rad": 0.1}


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
    def is_none(self) -> bool:
        """Whether nothing measures so badly: residuals of which nothing is declared tell by their size alone."""
        return self.declared is None and self.found > _MOST[self.unit]

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
    a pose together (Patterson and Thompson, Biometrika 58, 1971); Newton's method on the logarithms.

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


def noise_factors(problem: Problem, fit: Solution, joint: float | None = None) -> tuple[float, ...]:
    """Estimate noise as :func:`find_noise` does, without how surely it is known, at a third of the cost.

    Args:
        problem: what was measured.
        fit: an estimate.
        joint: what joint readings err by, to a factor of 1.5; None where the residuals alone tell. Joint models of all
            kinds together can take up what readings err by in a few poses: without any noise each would be certain.

    Returns:
        For each kind of measurement its standard deviations over the declared ones; last that of joint readings. [rad]
    """
    with one_blas_thread():
        _, found, _ = _likeliest(problem, fit, joint)
    return tuple(np.sqrt(found).tolist())


def _likeliest(
    problem: Problem, fit: Solution, joint: float | None = None
) -> tuple[_Likelihood, Floats, _LikelihoodValue]:
    """The likelihood of the variances at an estimate, the likeliest ones, and its value there."""
    parts: list[_Part] = []
    for observed, kept in zip(problem.observations, fit.kept, strict=True):
        parts.append(_Part.of(problem, fit, observed, kept, 1 + max((of.scaled_by.max() for of in parts), default=-1)))
    meant = None if joint is None else 2.0 * log(max(joint, _LEAST_JOINT))
    likelihood = _Likelihood(tuple(parts), *fit.parameters.prior_residuals(fit.state), meant)
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

    def products(self, W: Whitening, columns: Floats, step: Floats, count: int) -> tuple[Floats, ...]:
        """What the derivatives by the logarithms of the variances are made of.

        With V the covariance, V_k the share of variance k in it, J the derivatives, e the residuals after a step of the
        parameters, and X = V^-1 [e J].

        Args:
            W: whitens at some variances.
            columns: (N, m D, 1 + p) the residuals and derivatives, whitened.
            step: (p,) of the parameters.
            count: number of variances, that of the joint readings the last.

        Returns:
            The traces of V^-1 V_k (k,) and of V^-1 V_k V^-1 V_l (k, k), X^T V_k X (k, 1 + p, 1 + p), and
            X^T V_k V^-1 V_l X (k, k, 1 + p, 1 + p).
        """
        size = columns.shape[2]
        trace, traces = np.zeros(count), np.zeros((count, count))
        once, twice = np.zeros((count, size, size)), np.zeros((count, count, size, size))
        X = W.shared(np.concatenate([columns[..., :1] + columns[..., 1:] @ step[:, None], columns[..., 1:]], axis=2))
        # The readings' share of V is A A^T, where each measurement's own noise is 1; V^-1 = 1 - G G^T.
        G = (W.A @ W.axes) / np.sqrt(1.0 + W.strength)[:, None]
        A, share = W.shared(W.shared(W.A)), W.strength / (1.0 + W.strength)
        shares, inner = {count - 1: W.A @ (np.swapaxes(W.A, 1, 2) @ X)}, {}
        trace[-1], traces[-1, -1] = np.sum(share), np.sum(share**2)
        for i in np.unique(self.scaled_by).tolist():
            mine = (self.used & (self.scaled_by == i))[..., None]
            shares[i], of = mine * X, mine * G
            inner[i] = np.swapaxes(of, 1, 2) @ of
            trace[i] = np.sum(mine) - np.sum(of**2)
            traces[i, i] = np.sum(mine) - 2.0 * np.sum(of**2)
            traces[[i, -1], [-1, i]] = np.sum(mine * A**2)
        for i, a in inner.items():
            for j, b in inner.items():
                traces[i, j] += np.sum(a * b)
        half = {k: W.shared(of) for k, of in shares.items()}
        for k, of in shares.items():
            once[k] = _products(X, of)
            for other, with_other in half.items():
                twice[k, other] = _products(half[k], with_other)
        return trace, traces, once, twice


@dataclass(frozen=True, eq=False)
class _LikelihoodValue:
    """The restricted log-likelihood at some variances, and its derivatives by their logarithms.

    Attributes:
        value: the log-likelihood.
        score: (k,) its derivative.
        information: (k, k) Fisher's: its expected second derivative, negative.
        observed: (k, k) its second derivative, negative.
    """

    value: float
    score: Floats
    information: Floats
    observed: Floats


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """The restricted likelihood of variances.

    Attributes:
        parts: the kinds of measurement.
        r_prior: (r,) residuals of the parameters' prior.
        J_prior: (r, p) their derivative.
        meant: logarithm of the joint readings' variance, about; None where nothing is known.
    """

    parts: tuple[_Part, ...]
    r_prior: Floats
    J_prior: Floats
    meant: float | None = None

    def maximise(self, variances: Floats, hold: int | None = None) -> tuple[Floats, _LikelihoodValue]:
        """Return the likeliest variances, one of them held, and the likelihood there."""
        free = np.flatnonzero(np.arange(len(variances)) != hold)
        least = np.append(np.full(len(variances) - 1, _LEAST_SHARE**2), _LEAST_JOINT**2)

        def further(at: _LikelihoodValue, curvature: Floats) -> Floats:
            step = np.zeros(len(variances))
            damped = curvature[np.ix_(free, free)] + _VAGUE * np.eye(len(free))
            step[free] = np.clip(np.linalg.solve(damped, at.score[free]), -_LARGEST_STEP, _LARGEST_STEP)
            result: Floats = np.maximum(variances * np.exp(step), least)
            return result

        at = self.at(variances)
        for _ in range(_ROUNDS):
            # Newton's steps need a handful of rounds where Fisher's scoring needs thirty, but may lead downwards.
            concave = np.linalg.eigvalsh(at.observed[np.ix_(free, free)])[0] > 0.0
            moved = further(at, at.observed if concave else at.information)
            new = self.at(moved)
            if concave and new.value < at.value:
                moved = further(at, at.information)
                new = self.at(moved)
            change = np.abs(np.log(moved / variances)).max()
            variances, at = moved, new
            if change < _SETTLED:
                break
        return variances, at

    def at(self, variances: Floats) -> _LikelihoodValue:
        """Evaluate."""
        H, g = self.J_prior.T @ self.J_prior, self.J_prior.T @ self.r_prior
        whitened, value = [], -0.5 * float(self.r_prior @ self.r_prior)
        for part in self.parts:
            own = np.broadcast_to(variances[part.scaled_by, None, None], (*part.used.shape, 1, 1))
            W = Whitening.of(own, np.sqrt(variances[-1]) * part.joint)
            columns = W(np.concatenate([part.residual, part.J], axis=2))
            whitened.append((W, columns))
            normal = _products(columns, columns)
            H, g = H + normal[1:, 1:], g + normal[1:, 0]
            logs = np.sum(part.used * np.log(variances[part.scaled_by])) + np.sum(np.log1p(W.strength))
            value -= 0.5 * float(logs + normal[0, 0])
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        scaled = H * np.outer(scale, scale)
        covariance = np.linalg.pinv(scaled, hermitian=True) * np.outer(scale, scale)
        step = -covariance @ g
        value += 0.5 * float(g @ covariance @ g) - 0.5 * float(np.linalg.slogdet(H)[1])
        products = [part.products(*of, step, len(variances)) for part, of in zip(self.parts, whitened, strict=True)]
        trace, traces, once, twice = (np.sum(of, axis=0) for of in zip(*products, strict=True))
        # P = V^-1 - V^-1 J C J^T V^-1 takes out what the parameters make up for, with C their covariance.
        by_parameters = covariance @ once[:, 1:, 1:]
        taken = np.einsum("kii->k", by_parameters)
        score = 0.5 * (once[:, 0, 0] - trace + taken)
        again = np.einsum("kij,lji->kl", by_parameters, by_parameters)
        information = 0.5 * (traces - 2.0 * np.einsum("ij,klji->kl", covariance, twice[:, :, 1:, 1:]) + again)
        moved = once[:, 0, 1:]
        observed = twice[:, :, 0, 0] - moved @ covariance @ moved.T - information - np.diag(score)
        if self.meant is not None:
            off = log(variances[-1]) - self.meant
            score[-1] -= _MEANT * off
            value -= 0.5 * _MEANT * off**2
            for of in (information, observed):
                of[-1, -1] += _MEANT
        return _LikelihoodValue(value, score, information, observed)


def _products(a: Floats, b: Floats) -> Floats:
    """Products (p, r) of columns (N, m, p) and (N, m, r), summed over all rows."""
    result: Floats = a.reshape(-1, a.shape[2]).T @ b.reshape(-1, b.shape[2])
    return result
