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

SAG, LAG = Term("compliance", ("a", "b")), Term("lag", ("a", "b"))
ONE = Term("lag", ("b",))
STEP = {SAG: np.array([0.0, 0.0, 5.0]), LAG: np.array([1.0, 0.0, 5.0]), ONE: np.array([0.0, 2.0, 5.0])}


class Told:
    """An estimate of three parameters: what it is with some terms, and how much worse these are than the best."""

    def __init__(self, included: tuple[Term, ...], worse: dict[tuple[Term, ...], float], forced: bool = False) -> None:
        self.included = included
        self.worse = {self.scales(terms).tobytes(): by for terms, by in worse.items()}
        self.steps = {self.scales(terms).tobytes(): sum((STEP[term] for term in terms), np.zeros(3)) for terms in worse}
        self.places = np.array([1, 0, -1])  # in another order, and one that no other model tells
        self.units = tuple(SimpleNamespace(term=term, forced=forced and term is SAG) for term in (ONE, LAG, SAG))

    def groups_of(self, model: str) -> list[str]:
        return ["once", "twice"] if model == "lag" else [model]

    def scales(self, terms: tuple[Term, ...]) -> np.ndarray:
        found = np.zeros((2, 2, 2))
        for term in terms:
            joints, group = [joint in term.joints for joint in "ab"], {"once": 0, "twice": 1}.get(term.group)
            found[("compliance", "lag").index(term.model), joints, slice(None) if group is None else group] = term.scale
        return found

    def score(self, terms: tuple[Term, ...]) -> float:
        return LEAST * len(terms) - self.worse.get(self.scales(terms).tobytes(), 50.0)

    def estimate(self, terms: tuple[Term, ...]) -> np.ndarray:
        return self.steps[self.scales(terms).tobytes()]


def doubted(of: Told, step: np.ndarray, weight: float) -> None:
    step = np.where(of.places >= 0, step[of.places], 0.0)
    np.testing.assert_allclose(model_doubt(of), weight * np.outer(step, step), atol=1e-12)


@pytest.mark.parametrize("worse", [0.0, 1.0, 3.9])
def test_what_explains_as_much_counts_by_its_evidence(worse: float) -> None:
    weight = np.exp(-worse) / (1.0 + np.exp(-worse))
    doubted(Told((SAG,), {(SAG,): 0.0, (SAG, LAG): worse}), STEP[LAG], weight)


@pytest.mark.parametrize(
    ("other", "step"),
    [
        ((), -STEP[SAG]),  # without it
        ((LAG,), STEP[LAG] - STEP[SAG]),  # another in its place
        ((ONE,), STEP[ONE] - STEP[SAG]),  # of one joint in its place
        ((SAG, ONE), STEP[ONE]),  # of one joint beside it
    ],
)
def test_a_model_may_be_missing_or_stand_in_the_place_of_another(other: tuple[Term, ...], step: np.ndarray) -> None:
    doubted(Told((SAG,), {(SAG,): 0.0, other: 0.0}), step, 0.5)


def test_what_is_ruled_out_does_not_count() -> None:
    assert not model_doubt(Told((SAG,), {(SAG,): 0.0, (SAG, LAG): 4.1})).any()


def test_what_is_ruled_out_leaves_its_share_to_the_others() -> None:
    doubted(Told((SAG,), {(SAG,): 0.0, (SAG, LAG): 0.0, (SAG, ONE): 4.1}), STEP[LAG], 0.5)


def test_that_an_arm_is_rigid_may_be_in_doubt_too() -> None:
    doubted(Told((), {(): 0.0, (LAG,): 0.0}), STEP[LAG], 0.5)


def test_what_the_session_switches_on_is_not_in_doubt() -> None:
    assert not model_doubt(Told((SAG,), {(SAG,): 0.0, (): 0.0, (LAG,): 0.0}, forced=True)).any()


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
    sure = replace(chosen.fit, spread=None, doubt=None)
    np.testing.assert_allclose(replace(sagged.fit, spread=None).covariance, sure.covariance + doubt, rtol=1e-9)
    (_, (low, high)), (_, (sure_low, sure_high)) = (tip_error(sagged.problem, fit) for fit in (sagged.fit, sure))
    assert high > sure_high
    assert low == sure_low
    # What is to be expected is the noise; what may be wrong raises the upper end.
    assert tip_error(sagged.problem, sagged.fit)[0] == tip_error(sagged.problem, sure)[0]
    assert sagged.evidence.tip.rms == pytest.approx(tip_error(sagged.problem, sure)[0], rel=1e-6)
    # The map of the workspace says the same.
    q = sagged.chain.random_values(300, np.random.default_rng(0))
    assert np.sqrt(np.mean(sagged.tip_sigma(q) ** 2)) == pytest.approx(sagged.evidence.tip.rms, rel=0.1)
