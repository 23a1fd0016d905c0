"""Links that bend: two flexures before a joint, found as what they are, and brought to every consumer."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

import urdfcal
from tests.estimation.test_joint_model_choice import OFF, calibrated, chosen
from urdfcal.arrays import rms
from urdfcal.errors import SessionError
from urdfcal.estimation.evaluation import compare_tips, explain
from urdfcal.estimation.joint_models import Readings
from urdfcal.estimation.joint_models.bending import Bending
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.io.writing import write_session
from urdfcal.robot.flexure import rigid_joints, spread_placements, with_flexures, without_flexures
from urdfcal.robot.gravity import masses_of
from urdfcal.robot.kinematics import link_poses, tip_poses
from urdfcal.session.bending import bent
from urdfcal.simulation.joint_errors import true_tips
from urdfcal.simulation.motion import MotionSettings, set_in_motion
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.simulation.truth import Simulated


@pytest.fixture(scope="module")
def data() -> Simulated:
    """A panda whose links bend, more than usual."""
    rig = read_rig(find_rig("panda"))
    return simulate(replace(rig, errors={"bending": 3e-5}), poses=40, seed=3)


@pytest.fixture(scope="module")
def found(data: Simulated) -> FittedCalibration:
    return calibrated(data.session, **{**OFF, "bending": True})


@pytest.fixture(scope="module")
def loaded(found: FittedCalibration, tmp_path_factory: pytest.TempPathFactory) -> urdfcal.Calibration:
    folder = tmp_path_factory.mktemp("result")
    found.save(folder / "calibration.json")
    return urdfcal.Calibration.load(folder)


def tip_error(data: Simulated, calibration: urdfcal.Calibration) -> float:
    """Of a calibration, over the workspace, the best alignment at the base. [m]"""
    q = calibration.chain.random_values(200, np.random.default_rng(1))
    return rms(compare_tips(calibration.forward(calibration.chain.readings(q)), true_tips(data, q)).position)


@pytest.mark.parametrize("rig", ["ur5", "stanford", "tiago_dual"])
def test_flexures_at_zero_change_nothing_and_can_be_taken_out_again(rig: str, simulated: Callable) -> None:
    session = simulated(rig, poses=6).session
    drawn, chain = session.chain, with_flexures(session.chain, session.chain.actuated[1:])
    assert len(chain.joints) == len(drawn.joints) + 2 * (len(drawn.actuated) - 1)
    assert chain.actuated == drawn.actuated
    np.testing.assert_array_equal(chain.readings(chain.joint_values(session.readings)), session.readings)
    for a, b in zip(
        link_poses(drawn, session.q, drawn.tips),
        link_poses(chain, chain.joint_values(session.readings), chain.tips),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, atol=1e-14)
    again = without_flexures(chain)
    assert (again.names, again.parents) == (drawn.names, drawn.parents)
    assert [(tip.link, tip.joint) for tip in again.tips] == [(tip.link, tip.joint) for tip in drawn.tips]
    np.testing.assert_array_equal(again.placements, drawn.placements)
    np.testing.assert_array_equal(spread_placements(chain, drawn.placements), chain.placements)
    assert without_flexures(drawn) is drawn


def test_a_link_bends_by_the_moment_of_all_that_it_carries(simulated: Callable) -> None:
    # Against the moments from Newton's law: weights times levers, in the axes of the link that bends.
    session = replace(simulated("panda", poses=6).session, joint_models={"bending": True})
    model, readings = Bending.of(session), Readings.of(session)
    assert model is not None
    masses, n = masses_of(session.urdf, session.chain), len(session.chain.joints)
    tip = session.chain.tips[0]
    joints = [replace(tip, joint=k, T_joint_link=np.eye(4)) for k in range(n)]
    frames = np.array(link_poses(session.chain, session.q, joints))
    centres = (frames @ np.column_stack([masses.center, np.ones(n)])[:, None, :, None])[..., :3, 0]
    features = model.features(readings).reshape(len(session.q), n, 2)
    for j in range(n):
        before = frames[j - 1] if j else np.broadcast_to(np.eye(4), frames[0].shape)
        axes = before @ session.chain.placements[j]
        lever = centres[j:] - frames[j][:, :3, 3]
        moment = np.cross(lever, masses.mass[j:, None, None] * session.gravity).sum(axis=0)
        expected = np.einsum("nik,ni->nk", axes[:, :3, :2], moment)
        np.testing.assert_allclose(features[:, j], expected, atol=1e-9)


def test_it_is_found_within_its_intervals_and_the_tip_is_nearer(data: Simulated, found: FittedCalibration) -> None:
    block = next(model for model in found.problem.joint_models if isinstance(model, Bending))
    sigma, true = found.sigmas_of(block.key), data.truth.joint_errors["bending"]
    known = np.isfinite(sigma)
    z = (found.fit.state[block.key] - true)[known] / sigma[known]
    assert known.sum() > 10
    assert np.mean(np.abs(z) < 2.0) > 0.8
    # Joints that yield, which is what is chosen without it, are not the same.
    elastic = calibrated(data.session, **{**OFF, "compliance": True})
    assert tip_error(data, found) < 0.7 * tip_error(data, elastic)


@pytest.mark.no_cover
def test_auto_leaves_it_to_the_measurements(data: Simulated, simulated: Callable) -> None:
    assert "bending" in chosen(calibrated(data.session, bending="auto"))
    assert Bending.of(data.session) is None
    rigid = calibrated(simulated("panda", poses=40).session, bending="auto")
    assert chosen(rigid) == {}
    assert "bending" in {trial.term.model for trial in rigid.comparison.chosen.joint_models}


def test_what_is_loaded_gives_the_same_numbers(found: FittedCalibration, loaded: urdfcal.Calibration) -> None:
    q = found.session.readings
    for a, b in zip(*(of.joint_values_with_jacobian(q) for of in (found, loaded)), strict=True):
        np.testing.assert_array_equal(a, b)
    expected = found.problem.joint_values(Readings.of(found.session), found.fit.state)
    np.testing.assert_allclose(loaded.joint_values(q), expected, atol=1e-13)
    np.testing.assert_array_equal(found.true_q, expected)
    seen = tip_poses(loaded.mechanism, expected)
    np.testing.assert_allclose(loaded.forward(q), seen, atol=1e-13)
    # The joints' own values alone do not have it: that is the rigid part.
    real = rigid_joints(loaded.mechanism)
    assert np.abs(tip_poses(loaded.calibrated, expected[:, real]) - seen).max() > 1e-4
    assert loaded.chain.names == found.chain.names == tuple(np.array(loaded.mechanism.names)[real])


def test_commands_make_up_for_it(loaded: urdfcal.Calibration) -> None:
    chain = loaded.chain
    q = chain.readings(chain.random_values(40, np.random.default_rng(2)))
    many = loaded.compensate(q)
    good = many.position < 1e-9
    assert good.mean() > 0.7
    wanted = tip_poses(chain, chain.joint_values(q))
    np.testing.assert_allclose(loaded.forward(many.q)[good, :3, 3], wanted[good, :3, 3], atol=2e-9)
    for k in np.flatnonzero(good)[:10]:
        one = loaded.compensate(q[k])
        assert np.linalg.norm(loaded.forward(one.q)[:3, 3] - wanted[k, :3, 3]) < 2e-9


def test_another_session_of_the_arm_is_explained_with_it(data: Simulated, loaded: urdfcal.Calibration) -> None:
    rig = read_rig(find_rig("panda"))
    other = simulate(replace(rig, errors={"bending": 3e-5}), poses=20, seed=4, arm_seed=3).session
    with_it = explain(loaded.calibrated, other, bends=loaded.joint_models)
    without = explain(loaded.calibrated, other)
    assert rms(with_it.residuals[0]) < 0.7 * rms(without.residuals[0])


def test_the_corrected_urdf_is_the_rigid_part(found: FittedCalibration) -> None:
    data = found.calibrated_urdf()
    assert b"bends" not in data
    (reason,) = (reason for reason in found.assessment.warnings if "a URDF cannot hold it" in reason)
    assert "bending of the links" in reason


@pytest.mark.parametrize("said", [True, "auto", {"panda_joint2": True, "panda_joint4": "auto"}])
def test_a_session_says_of_which_links_it_is_asked(said: object, simulated: Callable, tmp_path: Path) -> None:
    session = replace(simulated("panda", poses=6).session, joint_models={"bending": said})
    write_session(tmp_path / "session", session)
    again = read_session(tmp_path / "session")
    assert again.joint_models == {"bending": said}
    assert len(bent(again).chain.joints) == 7 + 2 * (len(said) if isinstance(said, dict) else 7)


def test_it_takes_masses_and_no_measured_torques(simulated: Callable) -> None:
    session = replace(simulated("panda", poses=40).session, joint_models={"bending": True})
    for other in (replace(session, urdf=None), replace(session, torques=np.zeros_like(session.q))):
        with pytest.raises(SessionError, match="bending is switched on, but what it depends on is not in this session"):
            calibrated(other, bending=True)


def test_a_session_whose_moments_are_not_known_is_explained_with_it_all_the_same(
    data: Simulated, loaded: urdfcal.Calibration
) -> None:
    # The result knows what its links weigh.
    session = replace(data.session, torques=np.zeros_like(data.session.q))
    bare = explain(loaded.calibrated, session, bends=loaded.joint_models)
    known = explain(loaded.calibrated, data.session, bends=loaded.joint_models)
    np.testing.assert_allclose(bare.residuals[0], known.residuals[0], atol=1e-9)
    # What the session says of bending is its calibration's, not this one's.
    said = replace(data.session, joint_models={"bending": True})
    rigid = replace(loaded.joint_models, found=(), mechanism=loaded.chain)
    assert rms(explain(loaded.calibrated, said, bends=rigid).residuals[0]) > 2.0 * rms(known.residuals[0])


def test_an_arm_that_bends_is_filmed_in_motion() -> None:
    rig = read_rig(find_rig("ur5"))
    still = simulate(replace(rig, errors={"bending": 3e-5}), poses=6, seed=0)
    moving = set_in_motion(still, MotionSettings())
    truth = moving.truth
    assert len(truth.without_flexures().chain.joints) == 6
    np.testing.assert_array_equal(spread_placements(truth.chain, truth.without_flexures().placements), truth.placements)
    assert np.abs(truth.q[:, ~np.isin(np.arange(18), rigid_joints(truth.chain))]).max() > 1e-5
    assert moving.session.q.shape[1] == 6
