from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import RIGID, sagging
from urdfcal.errors import CalibrationError
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.model_selection import Trial, _preferred, with_fit
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.regions import joint_regions
from urdfcal.estimation.validation import hold_out, loss
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import DHTable
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.result.fitted import FittedCalibration

pytestmark = pytest.mark.usefixtures("no_trials")
GIVEN, FREE = (ModelSpec("dh", (word,) * 2, ("fixed",) * 2) for word in ("fixed", "free"))


def trial(spec: ModelSpec, logs: np.ndarray, score: float = 0.0) -> SimpleNamespace:
    """A cross-validated model whose scores log(1 + norm^2) are given."""
    return SimpleNamespace(spec=spec, loss=score, judged=SimpleNamespace(norms=(np.sqrt(np.expm1(logs)),)))


@pytest.mark.parametrize(
    ("spec", "rival", "better_by", "preferred"),
    [
        # Differences of standard deviation 1 over 100 measurements: three standard errors are 0.3.
        (FREE, GIVEN, 0.31, True),
        (FREE, GIVEN, 0.29, False),
        (GIVEN, FREE, -0.29, True),
        (GIVEN, FREE, -0.31, False),
    ],
)
def test_given_lenses_are_left_only_for_a_certain_improvement(
    spec: ModelSpec, rival: ModelSpec, better_by: float, preferred: bool
) -> None:
    valid = np.ones((55, 2), dtype=bool)
    valid[50:] = False
    usual = np.full((55, 2), 5.0)
    logs = usual - better_by + [1.0, -1.0]
    logs[50:] = 20.0 * np.sign(better_by)  # padding says the opposite
    logs[50:] -= logs[50:].min() - 1e-3
    problem = SimpleNamespace(observations=[SimpleNamespace(valid=valid)])
    assert _preferred(trial(spec, logs), trial(rival, usual), problem) == preferred


def test_of_models_with_the_same_lenses_the_better_one_is_preferred() -> None:
    logs, problem = np.full((4, 2), 1.0), SimpleNamespace(observations=[SimpleNamespace(valid=np.ones((4, 2), bool))])
    simple = GIVEN.nominal_arm
    assert _preferred(trial(simple, logs, 0.9), trial(GIVEN, logs, 1.0), problem)
    assert not _preferred(trial(simple, logs, 1.0), trial(GIVEN, logs, 1.0), problem)
    assert not _preferred(trial(GIVEN, logs, 1.1), trial(simple, logs, 1.0), problem)


@pytest.fixture(scope="module")
def open_choice(fitted: Callable) -> FittedCalibration:
    """A calibration of a session that leaves every choice to the data."""
    return fitted("elbow3r")


def test_every_model_is_tried_and_those_that_could_be_the_best_are_cross_validated(
    open_choice: FittedCalibration,
) -> None:
    comparison = open_choice.comparison
    specs = [attempt.spec for attempt in comparison.attempts]
    assert len(set(specs)) == len(specs) == 6
    trials = [attempt for attempt in comparison.attempts if isinstance(attempt, Trial)]
    assert comparison.best is min(trials, key=lambda each: each.loss)
    assert sum(each is comparison.chosen for each in trials) == 1
    for attempt in comparison.attempts:
        assert isinstance(attempt, Trial) or attempt.seen_loss >= comparison.chosen.loss
    assert comparison.nominal_arm.spec == comparison.chosen.spec.nominal_arm
    assert comparison.chosen.spec.geometry == "dh"


def test_held_out_scores_are_worse_than_those_of_poses_in_the_fit(open_choice: FittedCalibration) -> None:
    trials = [attempt for attempt in open_choice.comparison.attempts if isinstance(attempt, Trial)]
    assert len(trials) >= 2
    assert all(each.loss > each.seen_loss for each in trials)


@pytest.mark.no_cover
def test_where_residuals_exceed_the_noise_models_are_compared_by_regions_left_out(
    simulated: Callable, open_choice: FittedCalibration
) -> None:
    assert open_choice.comparison.chosen.elsewhere is None
    data = simulated("panda", poses=15, seed=2)
    bent = calibrate(replace(sagging(data, 7e-5), joint_models=RIGID), force=True)
    comparison, observations = bent.comparison, bent.problem.observations
    offsets, rows = (attempt for attempt in comparison.attempts[1:3] if isinstance(attempt, Trial))
    for each in (offsets, rows):
        assert each.loss == loss(each.elsewhere.norms, observations)
        regions = hold_out(bent.problem, each.fit, joint_regions(bent.problem))
        assert each.elsewhere.norms[0] == pytest.approx(regions.norms[0])
    # Among the other poses DH rows predict better, and elsewhere they do not.
    assert loss(rows.held_out.norms, observations) < loss(offsets.held_out.norms, observations)
    assert comparison.chosen is offsets
    again = with_fit(comparison, offsets.fit, bent.problem, bent.seed)
    assert again.chosen.loss == pytest.approx(offsets.loss)


def test_another_fit_takes_the_place_of_the_chosen_one(open_choice: FittedCalibration) -> None:
    comparison = open_choice.comparison
    fit = replace(comparison.chosen.fit)
    other = with_fit(comparison, fit, open_choice.problem, open_choice.seed)
    assert other.chosen.fit is fit
    assert [attempt is other.chosen for attempt in other.attempts].count(True) == 1
    assert other.chosen.loss == pytest.approx(comparison.chosen.loss, rel=1e-6)
    assert (other.best is other.chosen) == (comparison.best is comparison.chosen)
    free = replace(comparison.chosen)
    assert with_fit(replace(comparison, best=free), fit, open_choice.problem, 0).best is free


@pytest.mark.no_cover
def test_a_session_decides_about_its_lenses_but_free_ones_are_tried(simulated: Callable) -> None:
    session = simulated("ur5").session
    cameras = tuple(replace(c, intrinsics=c.intrinsics * [1.02, 1.02, 1.0, 1.0]) for c in session.rig.cameras)
    wrong = replace(session, rig=replace(session.rig, cameras=cameras))
    wrong = replace(wrong, joint_models=RIGID)
    said = calibrate(replace(wrong, estimate=Estimate("dh", "fixed", "fixed")), force=True).comparison
    assert said.chosen.spec.intrinsics == ("fixed", "fixed")
    assert said.best.spec.intrinsics == ("free", "free")
    left_open = calibrate(replace(wrong, estimate=Estimate("dh")))
    assert left_open.comparison.chosen.spec.intrinsics == ("free", "free")
    assert left_open.failures == ()


@pytest.mark.no_cover
def test_where_there_is_nothing_to_correct_nothing_is_corrected(simulated: Callable, true_state: Callable) -> None:
    data = simulated("elbow3r")
    session = replace(data.session, q=data.truth.q)
    table = DHTable.from_chain(session.chain)
    problem = Problem.of(session, table)
    (observed,) = problem.observations
    nominal = replace(data, truth=replace(data.truth, offsets=np.zeros_like(data.truth.offsets)))
    uv = observed.by_row(problem.predict(observed, true_state(nominal)))
    uv = uv + np.random.default_rng(0).normal(0.0, 0.1, uv.shape)
    session = replace(session, measurements=(replace(session.find(Detections), uv=uv),))
    with pytest.raises(CalibrationError, match="does not predict held-out poses better than the nominal one"):
        calibrate(session)
    comparison = calibrate(session, force=True).comparison
    assert comparison.chosen is comparison.nominal_arm
