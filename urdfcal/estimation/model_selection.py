"""Which spec the data support: nested models, compared by the poses they have not seen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from urdfcal.errors import CalibrationError
from urdfcal.estimation.blocks.arm import ArmBlock
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.model_spec import allowed, candidates, nominal
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.solver import solve
from urdfcal.estimation.validation import hold_out, loss

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.estimation.identifiability import Identifiability
    from urdfcal.estimation.model_spec import ModelSpec
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Progress, Solution
    from urdfcal.estimation.state import State
    from urdfcal.estimation.validation import HeldOut
    from urdfcal.session.model import Session

# Held-out residuals that shrink by this factor with lenses set free refute the lenses as given: the arm would be
# bent to make up for them (a measured session of a Motoman arm: 3.0 against 1.0 px, and an arm ten times worse).
_REFUTED = 1.5
# Residuals this many times the declared noise are no noise: wrong tip links and exchanged columns start at a hundred,
# careless declarations end at five or so.
_ABSURD = 20.0
_MANY_OUTLIERS = 0.25
# Lenses that were calibrated are knowledge: freeing them must better the prediction by this many standard errors.
_CERTAIN = 3.0
_STRANGE = 20.0


@dataclass(frozen=True, eq=False)
class Attempt:
    """One model, estimated from all poses.

    Attributes:
        spec: the model.
        identifiability: what the sightings tell of its parameters.
        fit: its estimate.
        seen_loss: of the poses it has seen; of unseen ones it cannot be lower.
    """

    spec: ModelSpec
    identifiability: Identifiability
    fit: Solution
    seen_loss: float


@dataclass(frozen=True, eq=False)
class Trial(Attempt):
    """One model, estimated and cross-validated.

    Attributes:
        held_out: its predictions of poses it has not seen.
        loss: of those, the lower the better.
    """

    held_out: HeldOut
    loss: float

    def residuals(self, what: Literal["residual", "distance"]) -> Floats:
        """Held-out residuals or distances of all sightings that are no outliers, (S,), in px or m."""
        parts: tuple[Floats, ...] = getattr(self.held_out, what)
        return np.concatenate([part[keep] for part, keep in zip(parts, self.fit.kept, strict=True)])


@dataclass(frozen=True, eq=False)
class Comparison:
    """The models that were tried.

    Attributes:
        nominal: the arm and the lenses as given; only base, LEDs and unknown camera poses fitted.
        attempts: every model, from simple to rich; those that could be the best are trials.
        chosen: of those that the session allows, the one that predicts unseen poses best.
        drawn: the chosen one's cameras with the arm as drawn.
        failures: why the chosen one should not be used.
    """

    nominal: Solution
    attempts: tuple[Attempt, ...]
    chosen: Trial
    drawn: Trial
    failures: tuple[str, ...]


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

    Args:
        session: what was measured, and what it wants estimated.
        problem: of its measurements.
        start: first state.
        priors: whether manufacturing tolerances act as priors.
        seed: of the division into folds.
        progress: called after every solver step.
    """
    base = nominal(session, start, priors=priors)
    as_given = solve(problem, start, choose_parameters(session, problem, start, base), progress)
    models = candidates(session, start, priors=priors)
    attempts: dict[ModelSpec, Attempt] = {}

    def attempt(spec: ModelSpec) -> Attempt:
        if spec not in attempts:
            # Lenses first, the arm after: freed together they start in a bent valley.
            state = as_given.state if spec.geometry == "none" else attempt(spec.nominal_arm).fit.state
            found = identify(problem, state, choose_parameters(session, problem, state, spec))
            fit = solve(problem, state, found.parameters, progress)
            attempts[spec] = Attempt(spec, found, fit, loss(fit.norms, problem.observations))
        return attempts[spec]

    def validated(spec: ModelSpec) -> Trial:
        tried = attempt(spec)
        if not isinstance(tried, Trial):
            attempts[spec] = tried = validate(tried, problem, seed)
        return tried

    chosen: Trial | None = None
    best: Trial | None = None
    for spec in sorted(models, key=lambda model: attempt(model).seen_loss):
        permitted = allowed(session, spec)
        rival = chosen if permitted else best
        if rival is not None and attempt(spec).seen_loss >= rival.loss:
            continue  # it explains what it has seen worse than the rival predicts what that has not
        trial = validated(spec)
        best = trial if best is None or trial.loss < best.loss else best
        if permitted and (chosen is None or _preferred(trial, chosen, problem)):
            chosen = trial
    if chosen is None or best is None:
        raise CalibrationError("the session allows no model", remedy="Look at its estimate.")
    drawn = validated(chosen.spec.nominal_arm)
    ordered = tuple(attempts[spec] for spec in dict.fromkeys((*models, *attempts)))
    return Comparison(as_given, ordered, chosen, drawn, tuple(_failures(session, best, chosen, drawn)))


def _preferred(trial: Trial, rival: Trial, problem: Problem) -> bool:
    """Whether a model predicts unseen poses better; lenses as given are left only for a certain improvement."""
    if trial.spec.intrinsics == rival.spec.intrinsics:
        return trial.loss < rival.loss
    difference = np.concatenate(
        [
            (np.log1p(a**2) - np.log1p(b**2))[of.valid]
            for a, b, of in zip(trial.held_out.norms, rival.held_out.norms, problem.observations, strict=True)
        ]
    )
    certain = _CERTAIN * float(np.std(difference) / np.sqrt(len(difference)))
    freer = trial.spec.free_lenses > rival.spec.free_lenses
    return float(np.mean(difference)) < (-certain if freer else certain)


def validate(attempt: Attempt, problem: Problem, seed: int) -> Trial:
    """Cross-validate an estimated model."""
    held_out = hold_out(problem, attempt.fit, seed)
    return Trial(
        attempt.spec,
        attempt.identifiability,
        attempt.fit,
        attempt.seen_loss,
        held_out,
        loss(held_out.norms, problem.observations),
    )


def with_fit(
    comparison: Comparison,
    fit: Solution,
    session: Session,
    problem: Problem,
    seed: int,
) -> Comparison:
    """The same comparison with another estimate of the chosen model."""
    old = comparison.chosen
    attempt = Attempt(old.spec, old.identifiability, fit, loss(fit.norms, problem.observations))
    chosen = validate(attempt, problem, seed)
    attempts = tuple(chosen if attempt is old else attempt for attempt in comparison.attempts)
    failures = tuple(_failures(session, chosen, chosen, comparison.drawn))
    return replace(comparison, attempts=attempts, chosen=chosen, failures=failures)


def _failures(session: Session, best: Trial, chosen: Trial, drawn: Trial) -> list[str]:
    failures = []
    fit = chosen.fit
    noise = float(np.sqrt(fit.reduced_chi2))
    if noise > _ABSURD:
        failures.append(
            f"the residuals are {noise:.0f} times the declared noise: this is not a robot like the drawn one; check "
            "the tip link, the order and the signs of the joint columns, their units, and the cameras"
        )
    cut, total = (sum(int(np.sum(part)) for part in parts) for parts in (fit.outlier, fit.kept))
    total += cut
    if cut > _MANY_OUTLIERS * total:
        failures.append(f"{cut} of {total} sightings had to be taken out as outliers: look at how LEDs were detected")
    strange = _offsets_in_tolerances(fit)
    if strange:
        failures.append(
            f"{', '.join(strange)}: no arm is built so far from its drawing; check the tip link and the joint "
            "columns, or name larger tolerances"
        )
    if not chosen.fit.converged:
        failures.append(
            f"the estimate did not settle in {len(chosen.fit.history)} steps: check the joint readings' columns and "
            "units, the tip link and the cameras"
        )
    if session.estimate.geometry != "none" and chosen.loss >= drawn.loss:
        failures.append(
            "the calibrated arm does not predict poses it has not seen better than the drawn one: more poses or less "
            "noise are needed, or there is nothing to correct"
        )
    if chosen.spec.intrinsics:
        with_given, with_free = (_rms(trial.residuals("residual")) for trial in (chosen, best))
        if with_given > _REFUTED * with_free:
            failures.append(
                f"the cameras' intrinsics as given are refuted by the sightings: poses not seen are predicted to "
                f"{with_given:.2f} px with them and to {with_free:.2f} px with free ones, so the arm would be bent to "
                "make up for the lenses; set estimate: {intrinsics: free}, or calibrate the cameras"
            )
    return failures


def _offsets_in_tolerances(fit: Solution) -> list[str]:
    """The offsets far beyond tolerance, in words; joints' zeros left out: on cheap arms they are anywhere."""
    words = []
    for block in fit.parameters.blocks:
        if not isinstance(block, ArmBlock):
            continue
        offsets, _ = block.local(fit.state[block.key])
        for name, row, offset, sigma in zip(block.names, block.rows, offsets, block.sigma, strict=True):
            if row not in block.arm.zeros and abs(offset) > _STRANGE * sigma:
                words.append(f"{name} would be off by {abs(offset) / sigma:.0f} tolerances")
    return words


def _rms(values: Floats) -> float:
    if values.size == 0:
        raise CalibrationError("no sighting is left: all are outliers", remedy="Check how LEDs were detected.")
    return float(np.sqrt(np.mean(values**2)))
