from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import sagging
from urdfcal.estimation.joint_model_average import model_doubt
from urdfcal.estimation.joint_model_choice import Alternatives
from urdfcal.estimation.joint_model_search import LEAST
from urdfcal.estimation.joint_models import Term
from urdfcal.estimation.uncertainty import tip_error
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.result.fitted import FittedCalibration

SAG, LAG = Term("compliance", ("a",)), Term("lag", ("a",))


class Told:
    """An estimate of one parameter with compliance: what it would be, and by how much worse, with lag beside it."""

    def __init__(self, worse: float, forced: bool = False) -> None:
        self.worse, self.places = worse, np.array([0, -1])
        self.included: tuple[Term, ...] = (SAG,)
        self.units = tuple(SimpleNamespace(term=term, forced=forced and term is SAG) for term in (SAG, LAG))

    def groups_of(self, model: str) -> list[str]:
        return [model]

    def score(self, terms: tuple[Term, ...]) -> float:
        known = {(("compliance", 1.0),): 0.0, (("compliance", 1.0), ("lag", 1.0)): LEAST - self.worse}
        return known.get(tuple((term.model, term.scale) for term in terms), -50.0) + LEAST

    def estimate(self, terms: tuple[Term, ...]) -> np.ndarray:
        return np.array([1.0, 3.0]) if LAG in terms else np.array([0.0, 3.0])


@pytest.mark.parametrize("worse", [0.0, 1.0, 3.9])
def test_what_explains_as_much_counts_by_its_evidence(worse: float) -> None:
    weight = np.exp(-worse) / (1.0 + np.exp(-worse))
    # What no other model tells is not in doubt.
    np.testing.assert_allclose(model_doubt(Told(worse)), [[weight, 0.0], [0.0, 0.0]], atol=1e-12)


def test_what_is_ruled_out_does_not_count() -> None:
    assert not model_doubt(Told(4.1)).any()


def test_an_arm_without_models_that_were_found_is_not_in_doubt() -> None:
    assert not model_doubt(Told(0.0, forced=True)).any()
    rigid = Told(0.0)
    rigid.included = ()
    assert not model_doubt(rigid).any()


@pytest.fixture(scope="module")
def sagged(simulated: Callable) -> FittedCalibration:
    session = sagging(simulated("panda", poses=30), 3e-5)
    return calibrate(replace(session, estimate=Estimate("dh", "fixed", "fixed")), force=True)


def test_doubt_widens_the_parameters_and_the_tips_interval(sagged: FittedCalibration) -> None:
    chosen = sagged.comparison.chosen
    told = Alternatives.of(sagged.session, sagged.problem, chosen.fit, chosen.spec.terms, 0)
    doubt = model_doubt(told)
    assert np.linalg.eigvalsh(doubt).min() > -1e-12 * np.abs(doubt).max()
    assert doubt.any()
    np.testing.assert_allclose(chosen.doubt, doubt, rtol=1e-6, atol=1e-6 * np.abs(doubt).max())
    # It is part of what is reported.
    sure = replace(chosen.fit, spread=None)
    assert np.all(np.diag(sagged.fit.covariance) >= np.diag(sure.covariance) + 0.99 * np.diag(doubt))
    (_, (low, high)), (_, (sure_low, sure_high)) = (tip_error(sagged.problem, fit) for fit in (sagged.fit, sure))
    assert high > sure_high
    assert low == sure_low
