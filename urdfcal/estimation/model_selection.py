"""Model selection: nested models, compared by how well they predict poses that they have not seen (METHOD 13)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from urdfcal.arrays import rms
from urdfcal.errors import CalibrationError
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.joint_model_average import model_doubt
from urdfcal.estimation.joint_model_choice import Alternatives, without
from urdfcal.estimation.joint_model_search import better_terms
from urdfcal.estimation.model_spec import allowed, candidates, nominal
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.regions import joint_regions
from urdfcal.estimation.solver import solve
from urdfcal.estimation.validation import hold_out, loss, random_folds

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.estimation.identifiability import Identifiability
    from urdfcal.estimation.joint_model_choice import JointModelTrial
    from urdfcal.estimation.model_spec import ModelSpec
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Progress, Solution
    from urdfcal.estimation.state import State
    from urdfcal.estimation.validation import HeldOut
    from urdfcal.session.model import Session

CERTAIN = 3.0
"""Lenses that were calibrated are knowledge: freeing them must better the prediction by so many standard errors."""
# Joint models are chosen on derivatives, and after they are estimated once more: so often at most.
_MOST_CHANGES = 3


@dataclass(frozen=True, eq=False)
class Attempt:
    """One model, estimated from all poses.

    Attributes:
        spec: the model.
        identifiability: which of its parameters the measurements identify.
        fit: its estimate.
        seen_loss: of the poses in the fit; of held-out ones it cannot be lower.
        joint_models: what each joint model brings, or would bring.
        doubt: (count, count) covariance of the estimate over other joint models; None where none was looked for.
    """

    spec: ModelSpec
    identifiability: Identifiability
    fit: Solution
    seen_loss: float
    joint_models: tuple[JointModelTrial, ...]
    doubt: Floats | None


@dataclass(frozen=True, eq=False)
class Trial(Attempt):
    """One model, estimated and cross-validated.

    Attributes:
        held_out: its predictions of poses left out at random.
        elsewhere: of regions left out, by which models are compared where the residuals are more than noise.
        loss: of what models are compared by, the lower the better.
    """

    held_out: HeldOut
    elsewhere: HeldOut | None
    loss: float

    @property
    def judged(self) -> HeldOut:
        """The predictions that models are compared by."""
        return self.elsewhere or self.held_out

    def residuals(self, what: Literal["residual", "distance"]) -> Floats:
        """Return the held-out residuals or distances of all measurements that are no outliers, (S,), in px or m."""
        parts: tuple[Floats, ...] = getattr(self.held_out, what)
        return np.concatenate([part[keep] for part, keep in zip(parts, self.fit.kept, strict=True)])

    def rms(self, what: Literal["residual", "distance"]) -> float:
        """Return the rms of :meth:`residuals`, in px or m.

        Raises:
            CalibrationError: all measurements are outliers.
        """
        values = self.residuals(what)
        if values.size == 0:
            raise CalibrationError("no measurement is left: all are outliers", remedy="Check how LEDs were detected.")
        return rms(values)


@dataclass(frozen=True, eq=False)
class Comparison:
    """The models that were tried.

    Attributes:
        nominal: the nominal arm and lenses; only base, LEDs and unknown camera poses fitted.
        attempts: every model, from simple to rich; those that could be the best are trials.
        best: the one that predicts what it has not seen best, whether the session allows it or not.
        chosen: of those that the session allows, the one that predicts what it has not seen best.
        nominal_arm: the chosen one's cameras with the nominal arm.
    """

    nominal: Solution
    attempts: tuple[Attempt, ...]
    best: Trial
    chosen: Trial
    nominal_arm: Trial

    def with_chosen(self, trial: Trial) -> Comparison:
        """Return the same with another trial of the chosen model."""
        old = self.chosen
        attempts = tuple(trial if attempt is old else attempt for attempt in self.attempts)
        best, nominal_arm = (trial if of is old else of for of in (self.best, self.nominal_arm))
        return replace(self, attempts=attempts, best=best, chosen=trial, nominal_arm=nominal_arm)


def compare_models(
    session: Session,
    problem: Problem,
    start: State,
    *,
    priors: bool,
    seed: int,
    progress: Progress | None = None,
) -> Comparison:
    """Estimate every model in question, cross-validate those that could be the best, and choose.

    Where even the model that explains the poses best leaves more than noise, poses left out at random cannot tell an
    arm from one that is bent to explain something else: the models are compared by regions left out.

    Args:
        session: what was measured, and what it wants estimated.
        problem: of its measurements.
        start: first state.
        priors: whether manufacturing tolerances act as priors.
        seed: of the division into folds.
        progress: called after every solver step.
    """
    base = nominal(session, start, priors=priors)
    nominal_fit = solve(problem, start, choose_parameters(session, problem, start, base), progress)
    models = candidates(session, start, priors=priors)
    attempts: dict[ModelSpec, Attempt] = {}

    def attempt(spec: ModelSpec) -> Attempt:
        if spec not in attempts:
            # Lenses first, the arm after: freed together they start in a bent valley.
            state = nominal_fit.state if spec.geometry == "none" else attempt(spec.nominal_arm).fit.state
            # Joint models would make up for geometry that is left out.
            rich = spec.geometry == models[-1].geometry
            attempts[spec] = _estimate(session, problem, state, spec, seed if rich else None, progress)
        return attempts[spec]

    ordered = sorted(models, key=lambda model: attempt(model).seen_loss)
    by_regions = attempt(ordered[0]).fit.misfit

    def validated(spec: ModelSpec) -> Trial:
        tried = attempt(spec)
        if not isinstance(tried, Trial):
            attempts[spec] = tried = validate(tried, problem, seed, by_regions=by_regions)
        return tried

    chosen: Trial | None = None
    best: Trial | None = None
    for spec in ordered:
        permitted = allowed(session, spec)
        rival = chosen if permitted else best
        if rival is not None and attempt(spec).seen_loss >= rival.loss:
            continue  # it explains the poses in its fit worse than the rival predicts those that are not in its own
        trial = validated(spec)
        best = trial if best is None or trial.loss < best.loss else best
        if permitted and (chosen is None or _preferred(trial, chosen, problem)):
            chosen = trial
    if chosen is None or best is None:
        raise CalibrationError("the session allows no model", remedy="Look at its estimate.")
    nominal_arm = validated(chosen.spec.nominal_arm)
    tried = tuple(attempts[spec] for spec in dict.fromkeys((*models, *attempts)))
    return Comparison(nominal_fit, tried, best, chosen, nominal_arm)


def _estimate(
    session: Session, problem: Problem, state: State, spec: ModelSpec, seed: int | None, progress: Progress | None
) -> Attempt:
    """Estimate a model; with a seed, and as long as the measurements speak for joint models, with these."""
    trials: tuple[JointModelTrial, ...] = ()
    doubt: Floats | None = None
    for last in range(_MOST_CHANGES, -1, -1):
        found = identify(problem, state, choose_parameters(session, problem, state, spec))
        fit = solve(problem, state, found.parameters, progress)
        if seed is None or spec.geometry == "none":
            break
        alternatives = Alternatives.of(session, problem, fit, spec.terms, seed)
        terms = better_terms(alternatives) if last else spec.terms
        if set(terms) == set(spec.terms):
            trials, doubt = alternatives.trials(), model_doubt(alternatives)
            break
        spec, state = replace(spec, terms=terms), without(fit.state, problem, terms)
    return Attempt(spec, found, fit, loss(fit.norms, problem.observations), trials, doubt)


def _preferred(trial: Trial, rival: Trial, problem: Problem) -> bool:
    """Return whether a model predicts the unseen better; given lenses are left only for a certain improvement."""
    if trial.spec.intrinsics == rival.spec.intrinsics:
        return trial.loss < rival.loss
    difference = np.concatenate(
        [
            (np.log1p(a**2) - np.log1p(b**2))[of.valid]
            for a, b, of in zip(trial.judged.norms, rival.judged.norms, problem.observations, strict=True)
        ]
    )
    certain = CERTAIN * float(np.std(difference) / np.sqrt(len(difference)))
    freer = trial.spec.free_lenses > rival.spec.free_lenses
    return float(np.mean(difference)) < (-certain if freer else certain)


def validate(attempt: Attempt, problem: Problem, seed: int, *, by_regions: bool) -> Trial:
    """Cross-validate an estimated model.

    Args:
        attempt: the model.
        problem: what was measured.
        seed: of the division into folds.
        by_regions: whether it is compared by regions left out.
    """
    held_out = hold_out(problem, attempt.fit, random_folds(problem, seed))
    elsewhere = hold_out(problem, attempt.fit, joint_regions(problem)) if by_regions else None
    return Trial(
        attempt.spec,
        attempt.identifiability,
        attempt.fit,
        attempt.seen_loss,
        attempt.joint_models,
        attempt.doubt,
        held_out,
        elsewhere,
        loss((elsewhere or held_out).norms, problem.observations),
    )


def with_fit(comparison: Comparison, fit: Solution, problem: Problem, seed: int) -> Comparison:
    """The same comparison with another estimate of the chosen model."""
    old = comparison.chosen
    seen = loss(fit.norms, problem.observations)
    attempt = Attempt(old.spec, old.identifiability, fit, seen, old.joint_models, old.doubt)
    return comparison.with_chosen(validate(attempt, problem, seed, by_regions=old.elsewhere is not None))
