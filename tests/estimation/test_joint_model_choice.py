from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import backlash, gain, harmonic, sagging, seen
from urdfcal.estimation import joint_model_search
from urdfcal.estimation.alignment import kabsch
from urdfcal.estimation.evaluation import explain
from urdfcal.estimation.joint_model_choice import Alternatives, without
from urdfcal.estimation.joint_model_search import _as_good, _transfers, better_terms
from urdfcal.estimation.joint_models import JOINT_MODELS, Readings, Term
from urdfcal.estimation.joint_models.backlash import Backlash
from urdfcal.estimation.joint_models.compliance import Compliance
from urdfcal.estimation.joint_models.gain import Gain
from urdfcal.estimation.joint_models.lag import Lag
from urdfcal.estimation.joint_models.leaning_compliance import LeaningCompliance
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.uncertainty import tip_error
from urdfcal.estimation.validation import hold_out, random_folds
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.robot.gravity import masses_of
from urdfcal.robot.kinematics import tip_poses
from urdfcal.session.knowledge import Estimate, Noise
from urdfcal.session.trajectory import AT_REST
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session

LINEAR = tuple(model for model in JOINT_MODELS if issubclass(model, LinearJointModel))
OFF = {model.name: False for model in LINEAR}
AS_GIVEN = Estimate("dh", "fixed", "fixed")


def calibrated(session: Session, **joint_models: object) -> FittedCalibration:
    estimate = replace(AS_GIVEN, gravity=session.estimate.gravity)
    return calibrate(replace(session, estimate=estimate, joint_models=joint_models), force=True)


@pytest.fixture(scope="module")
def sagged(simulated: Callable) -> FittedCalibration:
    """An arm that bends under its weight, with all that may be the reason to choose from."""
    return calibrated(sagging(simulated("panda", poses=60), 3e-5))


def chosen(calibration: FittedCalibration) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for term in calibration.comparison.chosen.spec.terms:
        found.setdefault(term.model, set()).update(term.joints)
    return found


def lagging(data, size: float):
    readings = Readings.of(data.session)
    return seen(data, data.truth.q - size * (readings.q - readings.previous))


def load_backlash(data, size: float):
    (j,) = (data.session.chain.names.index("panda_joint4"),)
    load = Compliance.of(data.session).features(Readings.of(data.session))[:, j]
    q = np.array(data.truth.q)
    q[:, j] += size * np.sign(load)
    return seen(data, q)


WORLDS: dict[str, tuple[Callable, float, str | None]] = {
    "lag": (lagging, 5e-4, None),
    "gain": (partial(gain, share=0.33), 1e-3, "panda_joint3"),
    "harmonics": (partial(harmonic, share=0.5, order=1), 1e-3, "panda_joint4"),
    "backlash": (partial(backlash, share=0.2), 1.5e-3, "panda_joint2"),
    "gravity_backlash": (load_backlash, 5e-4, "panda_joint4"),
}


@pytest.mark.no_cover
@pytest.mark.parametrize("model", WORLDS)
def test_what_an_arm_does_is_chosen_and_nothing_else(model: str, simulated: Callable) -> None:
    make, size, joint = WORLDS[model]
    calibration = calibrated(make(simulated("panda", poses=60), size))
    found = chosen(calibration)
    assert set(found) == {model}
    if joint is not None:
        assert found[model] == {joint}


def test_that_an_arm_sags_is_chosen_and_nothing_else(sagged: FittedCalibration) -> None:
    assert set(chosen(sagged)) == {"compliance"}


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", ["ur5", "stanford", "so101", "tiago_dual"])
def test_a_rigid_arm_stays_rigid(rig: str, simulated: Callable) -> None:
    calibration = calibrated(simulated(rig, poses=40).session)
    assert chosen(calibration) == {}
    assert not any(trial.included for trial in calibration.comparison.chosen.joint_models)


@pytest.mark.no_cover
@pytest.mark.parametrize("said", [True, False])
def test_what_readings_err_by_in_a_few_poses_is_no_joint_model(said: bool, simulated: Callable) -> None:
    # A board that is seen so well tells six numbers of each of twenty poses. All joint models together can make up for
    # what the readings err by there; and then that would come out as nothing, and each model as certain.
    session = simulated("ur5_charuco", poses=20, seed=2, pixel=0.01).session
    session = session if said else replace(session, noise=Noise(pixel=0.01))
    assert chosen(calibrated(session)) == {}


@pytest.mark.no_cover
def test_what_is_not_chosen_is_known_as_well_as_if_it_were(simulated: Callable) -> None:
    session, joint = simulated("ur5", poses=40).session, "elbow_joint"
    rigid = calibrated(session)
    (trial,) = [of for of in rigid.comparison.chosen.joint_models if of.term.model == "lag"]
    assert {*trial.candidates} == {f"{name}.lag" for name in session.chain.actuated}
    value, sigma = trial.candidates[f"{joint}.lag"]
    others = dict.fromkeys(session.chain.actuated, False)
    forced = calibrated(session, **{**OFF, "lag": {**others, joint: True}})
    (entry,) = forced.document.parameters
    # The usual prior pulls the one, a 25 times wider one the other.
    usual = Lag.revolute.sigma
    told, known = sigma**-2 - (25.0 * usual) ** -2, entry.sigma**-2 - usual**-2
    assert told == pytest.approx(known, rel=0.2)
    assert value * sigma**-2 == pytest.approx(entry.offset * entry.sigma**-2, abs=0.3 / entry.sigma)
    # Of what the estimate has there are none, nor of what the session switches off.
    (trial,) = forced.comparison.chosen.joint_models
    assert trial.candidates == {}


@pytest.mark.no_cover
def test_what_is_switched_off_is_not_chosen(simulated: Callable) -> None:
    session = sagging(simulated("panda", poses=30), 3e-5)
    assert "compliance" not in chosen(calibrated(session, compliance=False))
    assert not calibrated(session, **OFF).comparison.chosen.joint_models


@pytest.mark.no_cover
def test_what_is_switched_on_for_a_joint_is_estimated_of_it_alone(simulated: Callable) -> None:
    session = simulated("panda", poses=40).session
    calibration = calibrated(session, **{**OFF, "harmonics": {"panda_joint2": True, "panda_joint3": False}})
    (block,) = [block for block in calibration.fit.parameters.blocks if block.key.name == "harmonics"]
    on = np.array(block.names)[block.active]
    assert {name.split(".")[0] for name in on} == {"panda_joint2"}
    assert {entry.name for entry in calibration.document.parameters} == set(on)


@pytest.mark.no_cover
def test_an_estimate_without_a_model_tells_what_one_with_it_would_be(simulated: Callable) -> None:
    # All that is chosen is chosen by linear algebra: it must agree with estimates made anew.
    session = sagging(simulated("panda", poses=60), 5e-6)
    rigid, elastic = (calibrated(session, **{**OFF, "compliance": on}) for on in (False, True))
    told = Alternatives.of(replace(session, joint_models={}), rigid.problem, rigid.fit, (), 0)
    (term,) = told.alike("compliance")
    (model,) = [model for model in elastic.problem.joint_models if model.name == "compliance"]
    found = elastic.fit.state[model.key][elastic.fit.parameters.active_columns(model.key)[1]]
    step = told.estimate((term,))[told.count :]
    assert step[step != 0.0] == pytest.approx(found, abs=0.05 * np.abs(found).max())
    # But for how the noise is weighed, the estimate without it is where it is.
    assert np.all(np.abs(told.estimate(())[: told.count]) < 0.3 * np.sqrt(np.diag(rigid.fit.covariance)))
    for terms, real in (((), rigid), ((term,), elastic)):
        inside, *_ = told.errors(terms)
        held_out = hold_out(real.problem, real.fit, random_folds(real.problem, 0))
        again = np.sqrt(np.mean(held_out.distance[0][real.fit.kept[0]] ** 2))
        assert np.sqrt(np.mean(inside)) == pytest.approx(again, rel=0.05)
    assert told.log_evidence(()) == 0.0


def test_a_parameter_that_is_not_certain_makes_the_tip_uncertain(simulated: Callable) -> None:
    session = sagging(simulated("panda", poses=30), 3e-5)
    elastic = calibrated(session, **{**OFF, "compliance": True})
    expected, _ = tip_error(elastic.problem, elastic.fit)
    fit = elastic.fit
    where, _ = fit.parameters.active_columns(
        next(m for m in elastic.problem.joint_models if m.name == "compliance").key
    )
    sharper = np.array(fit.information)
    sharper[where, where] += 1e16 * np.eye(where.stop - where.start)  # as if it were known exactly
    known, _ = tip_error(elastic.problem, replace(fit, information=sharper))
    assert known < expected


def test_what_a_model_brings_is_told_of_each_joint_and_in_other_regions(sagged: FittedCalibration) -> None:
    trials = {trial.term.model: trial for trial in sagged.comparison.chosen.joint_models}
    sag, harmonics = trials["compliance"], trials["harmonics"]
    assert sag.included
    assert min(sag.inside, sag.elsewhere) > 1e-4
    assert sag.log_evidence > 20.0
    # The shoulder carries most of the arm, the wrist little of it.
    assert sag.by_joint["panda_joint2"] > 1e-4 > abs(sag.by_joint["panda_joint6"])
    assert not harmonics.included
    assert not harmonics.by_joint
    assert abs(harmonics.inside) < 1e-4


def test_what_a_urdf_cannot_hold_is_said(simulated: Callable, sagged: FittedCalibration) -> None:
    data, calibration = simulated("panda", poses=60), sagged
    (said,) = [reason for reason in calibration.warnings if "URDF cannot hold it" in reason]
    assert "export --to urdf --workspace" in said
    assert "compensate" in said
    assert said.startswith("sag of the joints under the arm's weight, by up to 1.")
    # Against the truth: the calibrated arm at the readings, and at where gravity truly takes the joints.
    chain = calibration.chain.with_placements(calibration.placements)
    sag = -3e-5 * masses_of(data.session.urdf, data.session.chain).torques(data.session.q)
    here, true = (tip_poses(chain, data.session.q + of)[:, :3, 3] for of in (0.0, sag))
    T = kabsch(here, true)
    loss = np.sqrt(np.mean(np.sum((here @ T[:3, :3].T + T[:3, 3] - true) ** 2, axis=1)))
    assert calibration.evidence.rigid_loss == pytest.approx(loss, rel=0.1)
    assert f"{1e3 * calibration.evidence.rigid_loss:.2g} mm rms" in said
    assert not [reason for reason in calibrated(data.session, **OFF).warnings if "URDF cannot hold it" in reason]


@pytest.mark.no_cover
def test_gears_of_one_kind_have_play_together(simulated: Callable) -> None:
    # None of the six is certain alone, and a lag would explain half of it.
    data = simulated("ur5", poses=60)
    (model,) = [kind.of(data.session) for kind in LINEAR if kind.name == "backlash"]
    size = np.random.default_rng(0).uniform(1e-4, 4e-4, len(model))
    session = seen(data, data.truth.q - model.values(Readings.of(data.session), size))
    (term,) = calibrated(session).comparison.chosen.spec.terms
    assert term.model == "backlash"
    assert term.joints == session.chain.names


@pytest.mark.parametrize(
    ("joints", "tips", "borne_out"),
    [
        ([1.0, 1.1, 0.9], [1.0, 1.1, 0.9], True),
        ([1.0, 1.1, 0.9], [1.6, 1.5, 1.4], False),  # of one kind of regions alone
        ([0.1, 2.0, 0.9], [1.0, 1.1, 0.9], False),  # within one standard error
    ],
)
def test_left_out_regions_of_both_kinds_bear_a_model_out(
    joints: list[float], tips: list[float], borne_out: bool
) -> None:
    before = [np.full(3, 1.5)] * 3
    assert _transfers(before, [np.full(3, 9.0), np.array(joints), np.array(tips)]) is borne_out


@pytest.mark.no_cover
@pytest.mark.parametrize(("here", "there", "most"), [("spread", "cubes", 0.62e-3), ("cubes", "spread", 0.53e-3)])
def test_a_measured_ur10_holds_in_another_region(
    here: str, there: str, most: float, shared: Path, measured: Callable
) -> None:
    # As drawn 0.78 and 0.98 mm, rigid 0.80 and 0.63 mm.
    calibration = measured(f"ur10_{here}")
    assert "compliance" in chosen(calibration)
    chain = calibration.chain.with_placements(calibration.placements)
    (residual,) = explain(chain, read_session(shared / f"ur10_{there}"), bends=calibration.joint_models).residuals
    assert np.sqrt(np.mean(np.sum(residual**2, axis=1))) < most


@pytest.mark.no_cover
def test_an_arm_that_bends_tells_where_gravity_points(simulated: Callable) -> None:
    # The base leans by 30 degrees, and the session knows nothing of it.
    data = simulated("panda", poses=60)
    down = 9.81 * np.array([0.5, 0.0, -np.sqrt(0.75)])
    leaning = replace(data, session=replace(data.session, gravity=down))
    session = sagging(leaning, 4e-5)
    upright = replace(session, gravity=data.session.gravity)
    found = calibrated(replace(upright, estimate=replace(AS_GIVEN, gravity="free")))
    assert "leaning_compliance" in chosen(found)
    model = next(m for m in found.problem.joint_models if m.name == "leaning_compliance")
    direction, sigma = model.direction(found.fit.state[model.key], found.sigmas_of(model.key))
    assert np.arccos(direction @ down / 9.81) < 3.0 * sigma < 0.25
    assert any("gravity points along [0." in warning for warning in found.document.warnings)
    # As true as with the direction known, but for what it costs to find it.
    sag = {**OFF, "compliance": True}
    (known, told, not_told) = (
        bent_error(of, data, session) for of in (calibrated(session, **sag), found, calibrated(upright, **sag))
    )
    assert told < 1.5 * known
    assert not_told > 2.0 * told


def bent_error(calibration: FittedCalibration, data, session) -> float:
    chain = data.session.chain
    q = chain.random_values(200, np.random.default_rng(1))
    load = Compliance.of(session).features(Readings(q, np.arange(200), AT_REST, np.zeros(200, dtype=np.intp)))
    true = tip_poses(chain.with_placements(data.truth.placements), q + 4e-5 * load)[:, :3, 3]
    here = calibration.forward(chain.readings(q))[:, :3, 3]
    T = kabsch(here, true)
    return float(np.sqrt(np.mean(np.sum((here @ T[:3, :3].T + T[:3, 3] - true) ** 2, axis=1))))


def test_a_joint_that_hardly_tells_does_not_turn_gravity_around() -> None:
    p = np.array([0.0, 0.0, -1e-5] * 3 + [0.0, 0.0, 4.5e-5])
    sigma = np.array([1e-6] * 9 + [4e-5] * 3)
    direction, uncertain = LeaningCompliance.direction(p, sigma)
    np.testing.assert_allclose(direction, [0.0, 0.0, -1.0], atol=0.05)
    assert uncertain < 0.1
    # Up or down is not known where joints contradict each other.
    assert LeaningCompliance.direction(np.array([0.0, 0.0, -1e-5, 0.0, 0.0, 1e-5]), np.full(6, 1e-6))[1] == np.pi


@pytest.mark.no_cover
def test_an_arm_that_is_not_rigid_has_every_model_weighed(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = read_rig(find_rig("so101"))
    errors = dict.fromkeys(("lag", "eccentricity", "backlash", "compliance", "gravity_backlash"), "default")
    session = simulate(replace(rig, errors=errors), poses=40, seed=0).session
    rigid = calibrated(session, **OFF)
    told = Alternatives.of(replace(session, joint_models={}), rigid.problem, rigid.fit, (), 0)
    terms = better_terms(told)
    monkeypatch.setattr(joint_model_search, "_weighed", lambda _, chosen: chosen)
    strict = better_terms(told)
    assert {term.model for term in strict} < {term.model for term in terms}
    assert told.log_evidence(terms) - len(terms) > told.log_evidence(strict) - len(strict)
    assert all(np.mean(a) < 1.1 * np.mean(b) for a, b in zip(told.errors(terms), told.errors(strict), strict=True))
    # What is switched on stays, whatever the evidence says.
    on = replace(session, joint_models={"gain": True, "lag": True})
    forced = calibrated(on, **{**OFF, "gain": True, "lag": True})
    monkeypatch.undo()
    again = better_terms(Alternatives.of(on, forced.problem, forced.fit, (), 0))
    assert len(again) > 2
    assert {"gain", "lag"} < {term.model for term in again}


@pytest.mark.parametrize(("worse", "kept"), [(1.04, True), (1.06, False)])
def test_what_is_weighed_must_not_spoil_a_region(worse: float, kept: bool) -> None:
    before = [np.array([5.0, 5.0]), np.array([1.0, 3.0]), np.array([2.0, 2.0])]
    after = [np.array([1.0, 1.0]), np.array([1.0, 1.0]), worse * before[2]]
    assert _as_good(before, after) is kept


class Told:
    """Alternatives of one joint as they are asked for: what is there gains 20, what may be there as much as is said."""

    def __init__(self, gains: dict[str, float], spoils: float = 1.0, forced: frozenset[str] = frozenset()) -> None:
        self.gains, self.spoils = {"compliance": 20.0, **gains}, spoils
        self.included = (Term("compliance", ("a",)),)
        self.units = tuple(SimpleNamespace(term=Term(name, ("a",)), forced=name in forced) for name in self.gains)

    def alike(self, model: str) -> list[Term]:
        return [Term(model, ("a",))]

    def groups_of(self, model: str) -> list[str]:
        return [model]

    def log_evidence(self, terms: tuple[Term, ...]) -> float:
        # The evidence is largest with priors as wide as they are.
        return sum(self.gains[term.model] - abs(np.log(term.scale)) for term in terms)

    def errors(self, terms: tuple[Term, ...]) -> list[np.ndarray]:
        worse = self.spoils if any(term.model == "lag" for term in terms) else 1.0
        return [np.ones(3), worse * np.ones(3), np.ones(3)]


@pytest.mark.parametrize(
    ("gain", "spoils", "taken"), [(1.1, 1.0, True), (0.9, 1.0, False), (9.0, 1.04, True), (9.0, 1.06, False)]
)
def test_a_model_is_weighed_in_for_enough_evidence_and_no_spoilt_region(
    gain: float, spoils: float, taken: bool
) -> None:
    chosen = {
        term.model: term.scale for term in joint_model_search._weighed(Told({"lag": gain}, spoils), Told({}).included)
    }
    assert chosen == {"compliance": 1.0, **({"lag": 1.0} if taken else {})}


def test_of_two_models_forced_on_the_same_joint_both_stay() -> None:
    told = Told({"lag": -5.0, "backlash": -5.0}, forced=frozenset({"lag", "backlash"}))
    start = (*told.included, Term("lag", ("a",)), Term("backlash", ("a",)))
    assert set(joint_model_search._weighed(told, start)) == set(start)


def test_groups_of_a_models_parameters_have_priors_of_their_own() -> None:
    told = SimpleNamespace(groups_of=lambda model: ["once", "twice"])
    options = joint_model_search.sizes(told, Term("harmonics", ("a", "b")))
    by_group = [{term.group: term.scale for term in option} for option in options]
    assert {None: 5.0} in by_group
    assert {"once": 5.0} in by_group
    assert {"once": 5.0, "twice": 0.3} in by_group
    assert all(term.joints == ("a", "b") for option in options for term in option)
    alone = SimpleNamespace(groups_of=lambda model: ["torque"])
    assert all(len(option) == 1 for option in joint_model_search.sizes(alone, Term("compliance", ("a",))))


def test_a_state_keeps_what_a_group_of_parameters_was_found_and_no_other(simulated: Callable) -> None:
    calibration = calibrated(simulated("so101", poses=12).session, **OFF)
    problem = calibration.problem
    (model,) = [model for model in problem.joint_models if model.name == "harmonics"]
    state = calibration.fit.state.replace({model.key: np.arange(1.0, len(model) + 1)})
    left = without(state, problem, [Term("harmonics", problem.mechanism.actuated[:2], group="harmonic 1")])[model.key]
    once = [name.endswith(("sin1", "cos1")) for name in model.names]
    kept = np.isin(model.names_of_joints, problem.mechanism.actuated[:2]) & once
    np.testing.assert_array_equal(left, np.where(kept, state[model.key], 0.0))


@pytest.mark.no_cover
def test_encoders_off_their_axes_err_once_a_turn_and_not_twice() -> None:
    rig = replace(read_rig(find_rig("so101")), errors={"eccentricity": "default"})
    data = simulate(rig, poses=60, seed=3)
    calibration = calibrated(data.session)
    (term,) = calibration.comparison.chosen.spec.terms
    assert (term.model, term.group) == ("harmonics", "harmonic 1")
    assert {entry.name.split(".")[-1] for entry in calibration.document.parameters} == {"sin1", "cos1"}
    (model,) = [model for model in calibration.problem.joint_models if model.name == "harmonics"]
    off = calibration.fit.state[model.key] - data.truth.joint_errors["harmonics"]
    sigma = calibration.fit.parameters.sigmas(calibration.fit.covariance)[calibration.fit.parameters.columns(model.key)]
    assert np.all(np.abs(off[~np.isnan(sigma)]) < 2.6 * sigma[~np.isnan(sigma)])


class Rivals:
    """A rigid arm that two models explain: by evidence, each at one scale; regions bear nothing out."""

    included: tuple[Term, ...] = ()

    def __init__(self, *rivals: tuple[str, float, float], certain: float = 0.0) -> None:
        self.gains = {name: (scale, gain) for name, scale, gain in rivals}
        self.units = tuple(
            SimpleNamespace(term=Term(name, ("a",)), forced=False, certain=certain) for name in self.gains
        )

    def score(self, terms: tuple[Term, ...]) -> float:
        return sum(gain for t in terms for scale, gain in [self.gains[t.model]] if t.scale == scale) - 100.0 * (
            len(terms) > 1
        )

    def errors(self, terms: tuple[Term, ...]) -> list[np.ndarray]:
        del terms
        return [np.ones(3)] * 3


@pytest.mark.parametrize(("more", "taken"), [(1.0, "gain"), (2.0, "compliance")])
def test_of_two_that_explain_as_much_the_one_of_usual_size_is_chosen(more: float, taken: str) -> None:
    told = Rivals(("compliance", 25.0, 40.0 + more), ("gain", 5.0, 40.0))
    (term,) = joint_model_search._step(told, ())
    assert term.model == taken  # five times the scale is worth log 5 = 1.6


@pytest.mark.parametrize(("gain", "taken"), [(6.1, True), (5.9, False)])
@pytest.mark.parametrize("model", [Gain, Backlash])
def test_gear_ratio_and_play_are_chosen_by_evidence_that_regions_do_not_bear_out(
    model: type[LinearJointModel], gain: float, taken: bool
) -> None:
    told = Rivals((model.name, 1.0, gain), certain=model.certain)
    assert (joint_model_search._step(told, ()) is not None) is taken
