"""Choose joint models: whether there are any by strict tests, then how large each is by the evidence (METHOD 13)."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.joint_model_choice import SCALES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_model_choice import Alternatives
    from urdfcal.estimation.joint_models import Term

# What the logarithm of the evidence must gain: odds of twenty.
_EVIDENCE = 3.0
# ... for a wider prior of what is there, a little.
_RESCALED = 1.0
LEAST = 1.0
"""What the logarithm of the evidence must gain by a further model of an arm that is not rigid.

Such an arm does others of these things, too, each too little to be told alone: of so101 with all of them at once two
are found by strict tests, the tip 1.40 x the bound off; with what adds so much to the evidence, 1.16 x. Half as much
has more models on that are not there, twice as much gives 1.24.
"""
_FINER = (0.3, 1.0, 2.0, 5.0, 10.0, 25.0)
# By so much worse left-out regions may be predicted: less than they differ by from each other.
_NO_WORSE = 1.05
_ROUNDS = 6


def better_terms(of: Alternatives) -> tuple[Term, ...]:
    """Return terms that the measurements speak for more than for those of the estimate, or the same.

    Of an arm taken for rigid, step by step a term is added, its priors are widened, or it is taken out: whatever the
    evidence gains most by. One that is not rigid has each model's priors as wide as the evidence is largest with.

    Args:
        of: the estimate and its alternatives.
    """
    chosen, forced = of.included, _forced(of)
    if set(chosen) == forced:
        for _ in range(2 * len(of.units)):
            step = _step(of, chosen)
            if step is None:
                break
            chosen = step
    return chosen if set(chosen) == forced else _weighed(of, chosen)


def _forced(of: Alternatives) -> set[Term]:
    return {unit.term for unit in of.units if unit.forced}


def _step(of: Alternatives, chosen: tuple[Term, ...]) -> tuple[Term, ...] | None:
    now, before = of.score(chosen), of.errors(chosen)
    options: list[tuple[float, tuple[Term, ...]]] = []
    for unit in of.units:
        mine = [term for term in chosen if _covers(unit.term, term)]
        if not mine and any(_covers(term, unit.term) for term in chosen):
            continue
        others = tuple(term for term in chosen if term not in mine)
        on = [term.joints for term in mine] == [unit.term.joints]
        least = _RESCALED if on else _EVIDENCE
        if on and not unit.forced and (gain := of.score(others) - now) > 0.0:
            options.append((gain, others))
        for scale in SCALES:
            term = replace(unit.term, scale=scale)
            gain = -np.inf if term in chosen else of.score((*others, term)) - now
            if gain > least and (on or gain > unit.certain or _transfers(before, of.errors((*others, term)))):
                # Of what explains as much, what is so many times larger than usual is as many times rarer: a wrong gear
                # ratio of an SO-101's shoulder is no compliance of 25 times what arms have, of 0.5 more evidence.
                options.append((gain - np.log(scale), (*others, term)))
    return max(options, key=lambda option: option[0], default=(0.0, None))[1]


def _weighed(of: Alternatives, chosen: tuple[Term, ...]) -> tuple[Term, ...]:
    """Widen, narrow, add or leave out each model in turn, until the evidence gains no more (MacKay 1992)."""
    forced = {(unit.term.model, unit.term.joints) for unit in of.units if unit.forced}
    for _ in range(_ROUNDS):
        before = set(chosen)
        for model in dict.fromkeys(unit.term.model for unit in of.units):
            kept = tuple(t for t in chosen if t.model != model or (model, t.joints) in forced)
            mine = tuple(term for term in chosen if term not in kept)
            whole = of.alike(model)[-1]
            options = [(), mine]
            if (model, whole.joints) not in forced:
                options += sizes(of, whole)
            values = [of.log_evidence((*kept, *option)) - LEAST * len(option) for option in options]
            best = options[int(np.argmax(values))]
            if best != mine and (not best or _as_good(of.errors(chosen), of.errors((*kept, *best)))):
                chosen = (*kept, *best)
        if set(chosen) == before:
            break
    return chosen


def sizes(of: Alternatives, whole: Term) -> list[tuple[Term, ...]]:
    """List what a model of all joints can be: each group of its parameters with priors of a width, or all with one.

    An encoder that is off its axis errs once a turn and hardly twice: priors of one width for both are too narrow for
    the first. Of so101 with such encoders every seventh parameter was outside its 95 % interval, and wrong gear ratios
    were found beside in 9 of 20.

    Args:
        of: the alternatives.
        whole: the model and the joints.
    """
    options: list[tuple[Term, ...]] = [(replace(whole, scale=scale),) for scale in _FINER]
    groups = of.groups_of(whole.model)
    if len(groups) > 1:
        each = [[None, *(replace(whole, scale=scale, group=group) for scale in _FINER)] for group in groups]
        options += [some for of_each in product(*each) if (some := tuple(term for term in of_each if term))]
    return options


def _covers(a: Term, b: Term) -> bool:
    return a.model == b.model and set(b.joints) <= set(a.joints)


def _transfers(before: Sequence[Floats], after: Sequence[Floats]) -> bool:
    """Return whether left-out regions of both kinds are predicted better (one-standard-error rule, Breiman 1984).

    Clusters of joint space alone let through harmonics of a UR10's first joint that spoil another region: 0.50 to 0.56
    mm.
    """
    pairs = zip(before[1:], after[1:], strict=True)
    return all(np.mean(new) + np.std(new, ddof=1) / np.sqrt(len(new)) < np.mean(old) for old, new in pairs)


def _as_good(before: Sequence[Floats], after: Sequence[Floats]) -> bool:
    """Return whether left-out regions of both kinds are predicted about as well."""
    return all(np.mean(new) < _NO_WORSE * np.mean(old) for old, new in zip(before[1:], after[1:], strict=True))
