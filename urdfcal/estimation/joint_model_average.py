"""How far an estimate depends on which joint models it has: Bayesian model averaging (METHOD 13)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.joint_model_choice import SCALES
from urdfcal.estimation.joint_model_search import LEAST, sizes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_model_choice import Alternatives
    from urdfcal.estimation.joint_models import Term

# Of the logarithm of the evidence below the largest: what is less likely by a factor of 55 counts as ruled out.
_RULED_OUT = 4.0


def model_doubt(of: Alternatives) -> Floats:
    """Compute how far other joint models that explain the measurements about as well would move an estimate.

    A model that is not there can look like one that is, and one too small to be chosen is taken up by those that are:
    of an SO-101 whose encoders are eccentric 94 % of the chosen models' parameters are within their 95 % intervals
    without this, 97 % with it. Where none is chosen of it, 85 % of the arm's parameters instead of 78 %, and 95 % of
    those of rigid arms, with and without. What differs from the estimate in one model, or has one in the place of
    another, counts by its evidence (Hoeting, Madigan, Raftery and Volinsky, Statistical Science 14, 1999).

    Args:
        of: the estimate and its alternatives.

    Returns:
        Covariance (count, count) of the estimate's active parameters about their values.
    """
    # Groups of one width each and all with that width are the same.
    distinct = {of.scales(terms).tobytes(): terms for terms in (*_others(of), of.included)}
    others = [terms for terms in distinct.values() if terms is not of.included]
    score = np.array([of.score(terms) - LEAST * len(terms) for terms in (of.included, *others)])
    weight = np.exp(score - score.max())
    weight[score < score.max() - _RULED_OUT] = 0.0
    weight /= weight.sum()
    here = of.estimate(of.included)
    steps = np.array([of.estimate(others[k]) - here for k in np.flatnonzero(weight[1:])]).reshape(-1, len(here))
    steps = np.where(of.places >= 0, steps[:, of.places], 0.0)
    covariance: Floats = (weight[1:][weight[1:] > 0.0] * steps.T) @ steps
    return covariance


def _others(of: Alternatives) -> Iterator[tuple[Term, ...]]:
    """Terms that differ from those of the estimate in one model, or have one in the place of another."""
    models = list(dict.fromkeys(unit.term.model for unit in of.units))
    forced = {unit.term for unit in of.units if unit.forced}
    for model in models:
        mine = tuple(term for term in of.included if term.model == model and term not in forced)
        rest = tuple(term for term in of.included if term not in mine)
        yield from ((*rest, *option) for option in _options(of, model))
        if mine:
            yield rest
            for other in models:
                if not any(term.model == other for term in rest) and other != model:
                    yield from ((*rest, *option) for option in _options(of, other))


def _options(of: Alternatives, model: str) -> list[tuple[Term, ...]]:
    """What a model can be: of all joints, in the sizes that are tried, or of one."""
    free = [unit.term for unit in of.units if unit.term.model == model and not unit.forced]
    if not free:
        return []
    alone = [(replace(term, scale=scale),) for term in free[:-1] for scale in SCALES]
    return [*sizes(of, free[-1]), *alone]
