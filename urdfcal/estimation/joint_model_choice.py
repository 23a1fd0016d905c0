"""What joint models explain, and what they predict where nothing was measured (METHOD 13).

All of it on the derivatives at an estimate: a model that is not in it has a column for each of its parameters, and what
an estimate with it would be follows from linear algebra. Only what is chosen is estimated anew.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import ReadOnly, one_blas_thread
from urdfcal.estimation.joint_models import Term
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.noise import noise_factors, with_noise
from urdfcal.estimation.regions import joint_regions, tip_regions
from urdfcal.estimation.validation import random_folds
from urdfcal.estimation.whitening import Whitening, joint_noise

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Session

# More poses say the same, only surer, and cost a pass over all.
_MOST_POSES = 1000
SCALES = (1.0, 5.0, 25.0)
"""Factors on priors' standard deviations: as they are, and wider, since joints of cheap arms are worse."""
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
        by_joint: what of ``inside`` is lost without a joint's part, for each joint of a model that is included. [m]
        candidates: of each parameter that is no part of the estimate and could be, by its name, what it would come out
            as with the joint's others alone, and its standard deviation. [unit of the parameter]
    """

    term: Term
    included: bool
    log_evidence: float
    inside: float
    elsewhere: float
    by_joint: Mapping[str, float]
    candidates: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Unit:
    """A joint model of one joint, or of all together, that can be chosen.

    Attributes:
        term: at the scale that it has.
        forced: whether the session switches it on.
        certain: what the evidence must gain that it is chosen although left-out regions do not bear it out.
    """

    term: Term
    forced: bool
    certain: float


@dataclass(frozen=True, eq=False)
class Alternatives:
    """An estimate, and what it would be with or without joint models, to first order.

    Attributes:
        units: what can be chosen: a model of one joint, or of all together.
        included: the terms that are part of the estimate.
        owner: (K,) the model, the joint and the group that each of all models' parameters belongs to.
        names: (K,) of these.
        sigma: (K,) standard deviations of these, at scale 1.
        divisions: of the poses: folds, clusters of joint space, clusters of tips.
        prior: (P + 1, P + 1) products of the prior's rows, of the estimate's own P parameters and the residual.
        places: (count,) of the estimate's active parameters among its own P and all models' K; -1 for one without.
        share: of the poses that are independent of each other.
    """

    units: tuple[Unit, ...]
    included: tuple[Term, ...]
    owner: tuple[tuple[str, str, str], ...]
    names: tuple[str, ...]
    sigma: Floats
    divisions: tuple[_Division, ...]
    prior: Floats
    places: Ints
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
        models = [model for model in problem.joint_models if isinstance(model, LinearJointModel)]
        units, columns = _units(session, thinned, models, terms)
        values = np.concatenate([fit.state[model.key] for model in models])[columns]
        everything = _with_all(fit, models, columns)
        P, parameters = everything.parameters.count - len(columns), everything.parameters
        # Noise is what no model explains: that of a rigid arm would hide behind it what is looked for.
        declared = problem.joint_sigma or noise_factors(problem, fit)[-1]
        *factors, joint = noise_factors(problem, everything, declared)
        labels = (random_folds(thinned, seed), joint_regions(thinned), tip_regions(thinned))
        with one_blas_thread():
            rows = []
            covariances = with_noise(thinned.observations, factors)
            for observed, covariance, some, kept in zip(thinned.observations, covariances, even, fit.kept, strict=True):
                at = Tangent.at(thinned, observed, fit.state, parameters).linearise()
                N, m, D = at.residual.shape
                used, J = kept[some], at.J.reshape(N, m * D, -1)
                X = np.concatenate([J, at.residual.reshape(N, m * D, 1) - J[..., P:] @ values[:, None]], axis=2)
                reading = joint_noise(at, thinned.mechanism.reading_jacobian, joint)
                W = Whitening.of(covariance / np.where(used, 1.0, _REJECTED)[..., None, None], reading)
                size = np.nan_to_num(thinned.metres_per_unit(observed, fit.state)) * used
                rows.append((observed.pose, W(X), np.repeat(size, D, axis=1)[..., None] * X, used.sum(axis=1)))
            divisions = tuple(_Division.of(label, rows) for label in labels)
            r, J_prior = parameters.prior_residuals(fit.state)
        own = ~np.any(J_prior[:, P:], axis=1)
        prior = np.column_stack([J_prior[own, :P], r[own]])
        poses = thinned.poses
        share = len(np.unique(thinned.readings.unit[poses])) / len(poses)
        sigma = np.concatenate([model.sigma for model in models])[columns]
        each = [(m.name, *of) for m in models for of in zip(m.names_of_joints, m.groups_of, strict=True)]
        owner = tuple(each[column] for column in columns)
        called = [name for model in models for name in model.names]
        names = tuple(called[column] for column in columns)
        forced = [unit.term for unit in units if unit.forced]
        included = (*forced, *(term for term in terms if term not in forced))
        places = _places(fit, models, columns)
        return cls(units, included, owner, names, sigma, divisions, prior.T @ prior, places, share)

    @property
    def count(self) -> int:
        """P, the number of the estimate's own parameters."""
        return len(self.prior) - 1

    @cached_property
    def _reduced(self) -> tuple[Floats, Floats]:
        """The normal equations (K, K) and (K,) of the models alone, whatever the estimate's own parameters are."""
        P, total = self.count, np.array(self.divisions[0].total)
        keep = [*range(P), len(total) - 1]
        total[np.ix_(keep, keep)] += self.prior
        S = self.share * (total[P:, P:] - total[P:, :P] @ _solve(total[:P, :P], total[:P, P:]))
        return S[:-1, :-1], S[:-1, -1]

    def alike(self, model: str) -> list[Term]:
        """List the units of a model, all joints together the last."""
        return [unit.term for unit in self.units if unit.term.model == model]

    def groups_of(self, model: str) -> list[str]:
        """List the groups of a model's parameters."""
        return list(dict.fromkeys(group for name, _, group in self.owner if name == model))

    def trials(self) -> tuple[JointModelTrial, ...]:
        """Return what each joint model brings, or would bring."""
        included = self.included
        found, now, errors = [], self.log_evidence(included), self.errors(included)
        for model in dict.fromkeys(unit.term.model for unit in self.units):
            mine = [term for term in included if term.model == model]
            other = tuple(term for term in included if term.model != model)
            whole = self.alike(model)[-1]
            term = Term(model, tuple(dict.fromkeys(joint for one in mine for joint in one.joints))) if mine else whole
            if not mine:
                other = (*other, whole)
            sign = 1.0 if mine else -1.0
            gains = [sign * gain for gain in self._losses(errors, other)]
            parts = {joint: self._losses(errors, _without(included, model, joint))[0] for joint in term.joints if mine}
            evidence = sign * (now - self.log_evidence(other))
            trial = JointModelTrial(term, bool(mine), evidence, gains[0], min(gains[1:]), ReadOnly(parts))
            found.append(replace(trial, candidates=ReadOnly(self._candidates(model))))
        return tuple(found)

    def _candidates(self, model: str) -> dict[str, tuple[float, float]]:
        """What parameters of a model that are no part of the estimate would come out as, joint by joint."""
        G, g = self._reduced
        found: dict[str, tuple[float, float]] = {}
        for joint in dict.fromkeys(joint for name, joint, _ in self.owner if name == model):
            sigma = self.scales(self.included)
            mine = [of[:2] == (model, joint) and not sigma[k] for k, of in enumerate(self.owner)]
            sigma[mine] = SCALES[-1] * self.sigma[mine]
            on = np.flatnonzero(sigma)
            C = np.linalg.inv(G[np.ix_(on, on)] * np.outer(sigma[on], sigma[on]) + np.eye(len(on)))
            value, spread = -sigma[on] * (C @ (g[on] * sigma[on])), sigma[on] * np.sqrt(np.diag(C))
            found |= {self.names[k]: (float(value[i]), float(spread[i])) for i, k in enumerate(on) if mine[k]}
        return found

    def _losses(self, errors: Sequence[Floats], chosen: Sequence[Term]) -> list[float]:
        """How much farther off poses are predicted with other terms, for each division. [m]."""
        return [_rms(after) - _rms(before) for before, after in zip(errors, self.errors(chosen), strict=True)]

    def scales(self, chosen: Sequence[Term]) -> Floats:
        """The standard deviations (K,) of all models' parameters with some terms: 0 for what is in none of them."""
        sigma = np.zeros(len(self.sigma))
        for term in chosen:
            mine = [
                model == term.model and joint in term.joints and term.group in (None, group)
                for model, joint, group in self.owner
            ]
            sigma[mine] = term.scale * self.sigma[mine]
        return sigma

    def log_evidence(self, chosen: Sequence[Term]) -> float:
        """Return the logarithm of the evidence of the estimate with some terms, but for a constant."""
        (G, g), sigma = self._reduced, self.scales(chosen)
        on = sigma > 0.0
        G, g = G[np.ix_(on, on)] * np.outer(sigma[on], sigma[on]) + np.eye(int(on.sum())), g[on] * sigma[on]
        return float(0.5 * g @ np.linalg.solve(G, g) - 0.5 * np.linalg.slogdet(G)[1])

    def estimate(self, chosen: Sequence[Term]) -> Floats:
        """Return the step (P + K,) to the estimate with some terms, of its own and all models' parameters."""
        keep, ridge = self._with(chosen)
        last = len(keep) - 1
        H = self.share * self.divisions[0].total[np.ix_(keep, keep)] + ridge
        found = np.zeros(self.count + len(self.sigma))
        found[keep[:last]] = -_solve(H[:last, :last], H[:last, last])
        return found

    def score(self, chosen: Sequence[Term]) -> float:
        """The evidence, less the logarithm of how many terms there are to choose from: one of n joints, or all."""
        choices = [
            len(SCALES) * (len(of) if len(term.joints) < len(of[-1].joints) else min(len(of), 2))
            for term in chosen
            for of in [self.alike(term.model)]
        ]
        return self.log_evidence(chosen) - float(np.sum(np.log(choices)))

    def errors(self, chosen: Sequence[Term]) -> tuple[Floats, ...]:
        """Return the mean squared distance in each part of each division, predicted from the others. [m^2]."""
        keep, ridge = self._with(chosen)
        return tuple(division.errors(keep, ridge) for division in self.divisions)

    def _with(self, chosen: Sequence[Term]) -> tuple[Ints, Floats]:
        """Select the columns of an estimate with some terms, the residual's the last, and their priors' products."""
        sigma, P = self.scales(chosen), self.count
        keep = np.concatenate([np.arange(P), P + np.flatnonzero(sigma), [P + len(sigma)]])
        ridge = np.zeros((len(keep), len(keep)))
        own = np.concatenate([np.arange(P), [len(keep) - 1]])
        ridge[np.ix_(own, own)] = self.prior
        inside = np.arange(P, len(keep) - 1)
        ridge[inside, inside] = sigma[sigma > 0.0] ** -2.0
        return keep, ridge


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


def _without(terms: Sequence[Term], model: str, joint: str) -> list[Term]:
    """Take a joint out of a model's terms."""
    return [replace(t, joints=tuple(j for j in t.joints if (t.model, j) != (model, joint))) for t in terms]


def _rms(squares: Floats) -> float:
    return float(np.sqrt(np.mean(squares)))


def _with_all(fit: Solution, models: Sequence[LinearJointModel], columns: Ints) -> Solution:
    """The estimate as one whose parameters are those of all models, too, of the middle scale."""
    blocks, first = [], 0
    for model in models:
        off = np.setdiff1d(np.arange(len(model)), columns - first)
        blocks.append(
            replace(model, sigma=SCALES[1] * model.sigma, fixed=dict.fromkeys(off.tolist(), "not looked for"))
        )
        first += len(model)
    return replace(fit, parameters=fit.parameters.including(blocks))


def _places(fit: Solution, models: Sequence[LinearJointModel], columns: Ints) -> Ints:
    """Where the estimate's active parameters are among its own and the columns of all models; -1 for one without."""
    places, first, own = np.full(fit.parameters.count, -1), 0, np.ones(fit.parameters.count, dtype=bool)
    found = {int(column): k for k, column in enumerate(columns)}
    P = fit.parameters.count - sum(int(fit.parameters.active_columns(model.key)[1].sum()) for model in models)
    for model in models:
        where, active = fit.parameters.active_columns(model.key)
        own[where] = False
        each = [found.get(first + int(k)) for k in np.flatnonzero(active)]
        places[where] = [-1 if k is None else P + k for k in each]
        first += len(model)
    places[own] = np.arange(P)
    return places


def _units(
    session: Session, problem: Problem, models: Sequence[LinearJointModel], terms: Sequence[Term]
) -> tuple[tuple[Unit, ...], Ints]:
    """List what can be chosen, and which of all models' parameters take part."""
    kept: list[Bools] = []
    groups: list[tuple[LinearJointModel, tuple[str, ...], bool]] = []
    for model in models:
        features, said = model.known_features(problem.readings), model.said(session)
        present = np.ptp(features, axis=0) > _NOTHING * max(float(np.abs(features).max(initial=0.0)), 1e-300)
        allowed = [said.get(joint, True) for joint in model.names_of_joints]
        kept.append(present & allowed)
        joints = [
            joint for joint in dict.fromkeys(model.names_of_joints) if np.any(kept[-1] & model.of_joints([joint]))
        ]
        for force in (True, False):
            some = tuple(joint for joint in joints if said.get(joint, False) == force)
            alone = [] if force or model.together or len(some) == 1 else [(joint,) for joint in some]
            groups += [(model, group, force) for group in (*alone, some) if group]
    columns = np.flatnonzero(np.concatenate(kept))
    units = []
    for model, group, force in groups:
        whole = Term(model.name, group)
        term = next((t for t in terms if replace(t, scale=1.0) == whole), whole)
        units.append(Unit(term, force, model.certain))
    return tuple(units), columns


def without(state: State, problem: Problem, terms: Sequence[Term]) -> State:
    """Return a state whose joint models are at their nominal value where they are in none of some terms."""
    values = {}
    for model in problem.joint_models:
        if isinstance(model, LinearJointModel):
            on = np.any([model.of_term(term) for term in terms], axis=0) if terms else False
            values[model.key] = np.where(on, state[model.key], model.nominal)
    return state.replace(values)
