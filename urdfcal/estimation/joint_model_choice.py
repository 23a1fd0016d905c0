"""Choose joint models by what they explain, and by what they predict where nothing was measured (METHOD 13).

All of it on the derivatives at an estimate: a model that is not in it has a column for each of its parameters, and what
an estimate with it would be follows from linear algebra. Only what is chosen is estimated anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import one_blas_thread
from urdfcal.estimation.joint_models import Term
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.noise import find_noise
from urdfcal.estimation.regions import joint_regions, tip_regions
from urdfcal.estimation.validation import random_folds
from urdfcal.estimation.whitening import JointNoise, joint_covariance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Session

# More poses say the same, only surer, and cost a pass over all.
_MOST_POSES = 1000
# What the logarithm of the evidence must gain: odds of twenty.
_EVIDENCE = 3.0
# Priors' standard deviations are tried as they are, and wider: joints of cheap arms are worse than those of good ones.
_SCALES = (1.0, 5.0, 25.0)
# ... for that, the logarithm of the evidence must gain a little.
_RESCALED = 1.0
# Share of the largest feature below which there is none.
_NOTHING = 1e-9
_RIDGE = 1e-12
_REJECTED = 1e-12


@dataclass(frozen=True)
class JointModelTrial:
    """What a joint model of some joints brings.

    Attributes:
        term: the model, its joints and the scale of its priors.
        included: whether it is part of the estimate.
        log_evidence: of the estimate with it, less that of the one without it.
        inside: how much nearer poses left out at random are predicted with it, root mean square. [m]
        elsewhere: the same of left-out regions. [m]
    """

    term: Term
    included: bool
    log_evidence: float
    inside: float
    elsewhere: float


@dataclass(frozen=True, eq=False)
class Alternatives:
    """An estimate, and what it would be with or without joint models, to first order.

    Attributes:
        units: what can be chosen, at the scale that it has, with its columns among the K of all models.
        on: which of them are part of the estimate.
        forced: which of them the session switches on.
        local: which of them must predict left-out regions better to be chosen.
        sigma: (K,) standard deviations of all models' parameters, at scale 1.
        divisions: of the poses: folds, clusters of joint space, clusters of tips.
        prior: (P + 1, P + 1) products of the prior's rows, of the estimate's own P parameters and the residual.
        numbers: how many were measured.
        share: of the poses that are independent of each other.
    """

    units: tuple[tuple[Term, Bools], ...]
    on: tuple[bool, ...]
    forced: tuple[bool, ...]
    local: tuple[bool, ...]
    sigma: Floats
    divisions: tuple[_Division, ...]
    prior: Floats
    numbers: int
    share: float

    @classmethod
    def of(cls, session: Session, problem: Problem, fit: Solution, terms: Sequence[Term], seed: int) -> Alternatives:
        """Take an estimate.

        Args:
            session: what it says of joint models.
            problem: what was measured.
            fit: the estimate.
            terms: joint models that are part of it beside those that the session switches on.
            seed: of the division into folds.
        """
        even = [observed.even(_MOST_POSES) for observed in problem.observations]
        thinned = problem.with_observations([of.at(some) for of, some in zip(problem.observations, even, strict=True)])
        parameters, models = fit.parameters, [m for m in problem.joint_models if isinstance(m, LinearJointModel)]
        own = np.ones(parameters.count, dtype=bool)
        for model in models:
            own[parameters.active_columns(model.key)[0]] = False
        units, forced, columns = _units(session, thinned, models, terms)
        values = np.concatenate([fit.state[model.key] for model in models])[columns]
        *found, joint = find_noise(problem, fit)
        readings = thinned.readings
        labels = (random_folds(thinned, seed), joint_regions(thinned), tip_regions(thinned))
        [[] for _ in labels]
        with one_blas_thread():
            kinds = zip(thinned.observations, even, fit.kept, found, strict=True)
            rows, numbers = [], 0
            for observed, some, kept, noise in kinds:
                at = Tangent.at(thinned, observed, fit.state, parameters).linearise()
                N, m, D = at.residual.shape
                used = kept[some]
                B = np.concatenate(
                    [model.jacobian(observed.readings, fit.state[model.key]) for model in models], axis=2
                )
                B = at.J_q @ B[..., columns]
                y = at.residual.reshape(N, m * D, 1) - B @ values[:, None]
                X = np.concatenate([at.J.reshape(N, m * D, -1)[..., own], B, y], axis=2)
                declared = float(np.sqrt(np.mean(observed.table.sigma**2)))
                covariance = (noise.found / declared) ** 2 * observed.covariance
                sigma = joint_covariance(at, thinned.arm.chain.reading_jacobian, joint.found)
                W = JointNoise(sigma, sigma).whitening(covariance, np.where(used, 1.0, _REJECTED))
                size = np.nan_to_num(thinned.metres_per_unit(observed, fit.state)) * used
                rows.append((observed.pose, W @ X, np.repeat(size, D, axis=1)[..., None] * X, used.sum(axis=1)))
                numbers += D * int(used.sum())
            divisions = tuple(_Division.of(label, rows) for label in labels)
            r, J = parameters.prior_residuals(fit.state)
        mine = ~np.any(J[:, ~own], axis=1)
        prior = np.column_stack([J[mine][:, own], r[mine]])
        poses = thinned.poses
        share = len(np.unique(readings.unit[poses])) / len(poses)
        on = tuple(
            force or any(t.model == u.model and set(u.joints) <= set(t.joints) for t in terms)
            for (u, _), force in zip(units, forced, strict=True)
        )
        everywhere = {model.name for model in models if model.everywhere}
        local = tuple(unit.model not in everywhere for unit, _ in units)
        return cls(
            units,
            on,
            forced,
            local,
            np.concatenate([m.sigma for m in models])[columns],
            divisions,
            prior.T @ prior,
            numbers,
            share,
        )

    @property
    def count(self) -> int:
        """P, the number of the estimate's own parameters."""
        return len(self.prior) - 1

    @cached_property
    def _reduced(self) -> tuple[Floats, Floats, float]:
        """The normal equations (K, K) and (K,) of the models alone, and the sum of squares without any."""
        P, total = self.count, self.divisions[0].total
        keep = [*range(P), len(total) - 1]
        total = np.array(total)
        total[np.ix_(keep, keep)] += self.prior
        S = total[P:, P:] - total[P:, :P] @ _solve(total[:P, :P], total[:P, P:])
        return S[:-1, :-1], S[:-1, -1], float(S[-1, -1])

    @property
    def included(self) -> tuple[Term, ...]:
        """The terms that are part of the estimate."""
        return tuple(term for (term, _), on in zip(self.units, self.on, strict=True) if on)

    def better(self) -> tuple[Term, ...]:
        """Return terms that the measurements speak for more than for those of the estimate, or the same.

        Step by step a term is added, its priors are widened, or it is taken out: whatever the evidence gains most by.
        """
        chosen = self.included
        for _ in range(2 * len(self.units)):
            step = self._step(chosen)
            if step is None:
                break
            chosen = step
        return chosen

    def _step(self, chosen: tuple[Term, ...]) -> tuple[Term, ...] | None:
        noise = self.noise(chosen)
        now, before = self.log_evidence(chosen, noise), self.errors(chosen)
        options: list[tuple[float, tuple[Term, ...]]] = []
        for (unit, _), forced, local in zip(self.units, self.forced, self.local, strict=True):
            others = tuple(term for term in chosen if not _same(term, unit))
            on = len(others) < len(chosen)
            least = _RESCALED if on else _EVIDENCE + np.log(len(_SCALES) * len(self.alike(unit)))
            if on and not forced:
                options.append((self.log_evidence(others, noise) - now, others))
            for scale in _SCALES:
                term = replace(unit, scale=scale)
                gain = -np.inf if term in chosen else self.log_evidence((*others, term), noise) - now
                if gain > least and (on or not local or _transfers(before, self.errors((*others, term)))):
                    options.append((gain, (*others, term)))
        gain, better = max(options, key=lambda option: option[0], default=(0.0, chosen))
        return better if gain > 0.0 else None

    def alike(self, unit: Term) -> list[Term]:
        """List the terms of a unit's model."""
        return [term for term, _ in self.units if term.model == unit.model]

    def trials(self) -> tuple[JointModelTrial, ...]:
        """Return what each joint model brings, or would bring."""
        included = self.included
        found, noise, errors = [], self.noise(included), self.errors(included)
        now = self.log_evidence(included, noise)
        for model in dict.fromkeys(unit.model for unit, _ in self.units):
            mine = [term for term in included if term.model == model]
            other = tuple(term for term in included if term.model != model)
            term = Term(model, tuple(joint for unit in mine or self.alike(Term(model, ())) for joint in unit.joints))
            if not mine:
                other = (*other, *self.alike(term))
            sign = 1.0 if mine else -1.0
            inside, joints, tips = (sign * (_rms(b) - _rms(a)) for a, b in zip(errors, self.errors(other), strict=True))
            evidence = sign * (now - self.log_evidence(other, noise))
            found.append(JointModelTrial(term, bool(mine), evidence, inside, min(joints, tips)))
        return tuple(found)

    def scales(self, chosen: Sequence[Term]) -> Floats:
        """The standard deviations (K,) of all models' parameters with some terms: 0 for what is in none of them."""
        sigma = np.zeros(len(self.sigma))
        for term in chosen:
            columns = next(columns for unit, columns in self.units if _same(unit, term))
            sigma[columns] = term.scale * self.sigma[columns]
        return sigma

    def log_evidence(self, chosen: Sequence[Term], noise: float) -> float:
        """Return the logarithm of the evidence of the estimate with some terms, but for a constant.

        Args:
            chosen: the terms.
            noise: variance of whitened residuals, see :meth:`noise`.
        """
        G, g = self._scaled(chosen)
        G, g = self.share / noise * G + np.eye(len(G)), self.share / noise * g
        return float(0.5 * g @ np.linalg.solve(G, g) - 0.5 * np.linalg.slogdet(G)[1])

    def noise(self, chosen: Sequence[Term]) -> float:
        """Return the variance of the whitened residuals of an estimate with some terms."""
        G, g = self._scaled(chosen)
        squares = self._reduced[2] - float(g @ np.linalg.solve(G + np.eye(len(G)), g))
        return max(squares, _RIDGE) / max(self.numbers - self.count, 1)

    def _scaled(self, chosen: Sequence[Term]) -> tuple[Floats, Floats]:
        """The normal equations of some terms, in standard deviations of their priors."""
        G, g, _ = self._reduced
        sigma = self.scales(chosen)
        on = sigma > 0.0
        return G[np.ix_(on, on)] * np.outer(sigma[on], sigma[on]), g[on] * sigma[on]

    def errors(self, chosen: Sequence[Term]) -> tuple[Floats, ...]:
        """Return the mean squared distance in each part of each division, predicted from the others. [m^2]."""
        sigma = self.scales(chosen)
        P = self.count
        keep = np.concatenate([np.arange(P), P + np.flatnonzero(sigma), [P + len(sigma)]])
        ridge = np.zeros((len(keep), len(keep)))
        own = np.concatenate([np.arange(P), [len(keep) - 1]])
        ridge[np.ix_(own, own)] = self.prior
        inside = np.arange(P, len(keep) - 1)
        ridge[inside, inside] = sigma[sigma > 0.0] ** -2.0
        return tuple(division.errors(keep, ridge) for division in self.divisions)


@dataclass(frozen=True, eq=False)
class _Division:
    """Poses divided into parts: products of the columns (C, C) over each part, whitened, and in metres."""

    whitened: Floats
    metres: Floats
    used: Floats

    @classmethod
    def of(cls, label: Ints, rows: Sequence[tuple[Ints, Floats, Floats, Ints]]) -> _Division:
        parts = np.unique(np.concatenate([label[pose] for pose, *_ in rows]))
        size = rows[0][1].shape[2]
        found = np.zeros((2, len(parts), size, size))
        used = np.zeros(len(parts))
        for pose, *columns, count in rows:
            for k, part in enumerate(parts):
                here = label[pose] == part
                used[k] += count[here].sum()
                for what, of in zip(found, columns, strict=True):
                    X = of[here].reshape(-1, size)
                    what[k] += X.T @ X
        return cls(found[0], found[1], used)

    @cached_property
    def total(self) -> Floats:
        """The whitened products over all parts."""
        result: Floats = self.whitened.sum(axis=0)
        return result

    def errors(self, keep: Ints, ridge: Floats) -> Floats:
        """Return the mean squared distance in each part by an estimate from the others. [m^2]."""
        some, last = np.ix_(keep, keep), len(keep) - 1
        found = np.zeros(len(self.used))
        for k in range(len(found)):
            H = (self.total - self.whitened[k])[some] + ridge
            x = np.append(-_solve(H[:last, :last], H[:last, last]), 1.0)
            found[k] = x @ self.metres[k][some] @ x / max(self.used[k], 1.0)
        return found


def _solve(H: Floats, g: Floats) -> Floats:
    """Solve normal equations in column-scaled form."""
    diagonal = np.diag(H)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = H * np.outer(scale, scale) + _RIDGE * np.eye(len(H))
    result: Floats = (scale * np.linalg.solve(scaled, (scale * g.T).T).T).T
    return result


def _transfers(before: Sequence[Floats], after: Sequence[Floats]) -> bool:
    """Return whether left-out regions of both kinds are predicted better (one-standard-error rule, Breiman 1984).

    Clusters of joint space alone let through harmonics of a UR10's first joint that spoil another region: 0.50 to 0.56
    mm.
    """
    pairs = list(zip(before[1:], after[1:], strict=True))
    return all(np.mean(new) + np.std(new, ddof=1) / np.sqrt(len(new)) < np.mean(old) for old, new in pairs)


def _rms(squares: Floats) -> float:
    return float(np.sqrt(np.mean(squares)))


def _same(a: Term, b: Term) -> bool:
    return (a.model, a.joints) == (b.model, b.joints)


def _units(
    session: Session, problem: Problem, models: Sequence[LinearJointModel], terms: Sequence[Term]
) -> tuple[tuple[tuple[Term, Bools], ...], tuple[bool, ...], Ints]:
    """List what can be chosen, whether it is forced, and which of all models' parameters take part."""
    names: list[tuple[int, str]] = []
    kept: list[bool] = []
    units: list[tuple[Term, bool, set[tuple[int, str]]]] = []
    for k, model in enumerate(models):
        features, said = model.known_features(problem.readings), model.said(session)
        present = np.ptp(features, axis=0) > _NOTHING * max(float(np.abs(features).max(initial=0.0)), 1e-300)
        joints = [
            j
            for j in dict.fromkeys(model.names_of_joints)
            if np.any(present & model.of_joints([j])) and said.get(j, True)
        ]
        names += [(k, j) for j in model.names_of_joints]
        kept += list(present & model.of_joints(joints))
        for force in (True, False):
            some = [j for j in joints if said.get(j, False) == force]
            for group in [some] if model.together and some else [[j] for j in some]:
                scale = next((t.scale for t in terms if t.model == model.name and set(group) <= set(t.joints)), 1.0)
                units.append((Term(model.name, tuple(group), scale), force, {(k, j) for j in group}))
    columns = np.flatnonzero(kept)
    owner = [names[c] for c in columns]
    return (
        tuple((term, np.array([o in of for o in owner], dtype=bool)) for term, _, of in units),
        tuple(force for _, force, _ in units),
        columns,
    )


def without(state: State, problem: Problem, terms: Sequence[Term]) -> State:
    """Return a state whose joint models are at their nominal value where they are in none of some terms."""
    values = {}
    for model in problem.joint_models:
        if isinstance(model, LinearJointModel):
            joints = [joint for term in terms if term.model == model.name for joint in term.joints]
            values[model.key] = np.where(model.of_joints(joints), state[model.key], model.nominal)
    return state.replace(values)
