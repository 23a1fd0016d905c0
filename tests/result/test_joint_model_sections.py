"""Joint models leave the estimate: what is loaded gives the same numbers, and they are those of the estimate."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

import urdfcal
from tests.estimation.joint_models.test_joint_models import LINEAR, session_for
from tests.worlds import sagging, seen
from urdfcal.errors import OutputError, RobotError, SessionError
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.joint_models import Readings
from urdfcal.estimation.joint_models.gravity_backlash import GravityBacklash
from urdfcal.output.workspace import sample_workspace
from urdfcal.pipeline import calibrate
from urdfcal.robot.kinematics import tip_poses
from urdfcal.session.knowledge import Payload

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.result.fitted import FittedCalibration

LOAD = Payload("tool0", 1.5, np.array([0.0, 0.02, 0.05]))


@pytest.fixture(scope="module")
def bent(simulated: Callable) -> FittedCalibration:
    """An arm that sags, with a payload, and with every model that applies switched on."""
    data = simulated("ur5", poses=40)
    session = replace(sagging(data, 3e-5), payload=LOAD, gear_ratio={"elbow_joint": 101.0})
    # A load changes sides where another payload is on the arm: what it does otherwise is smooth.
    on = {kind.name: kind.of(session) is not None and kind is not GravityBacklash for kind in LINEAR}
    return calibrate(replace(session, joint_models=on), force=True)


@pytest.fixture(scope="module")
def loaded(bent: FittedCalibration, tmp_path_factory: pytest.TempPathFactory) -> urdfcal.Calibration:
    folder = tmp_path_factory.mktemp("result")
    bent.save(folder / "calibration.json")
    return urdfcal.Calibration.load(folder)


def test_what_is_loaded_gives_the_same_numbers_to_the_last_bit(
    bent: FittedCalibration, loaded: urdfcal.Calibration
) -> None:
    q, previous = bent.session.readings, bent.chain.readings(bent.session.came_from)
    for payload in (None, Payload("tool0", 3.0, np.zeros(3))):
        given = {"previous": previous, "payload": payload}
        for a, b in zip(*(of.joint_values_with_jacobian(q, **given) for of in (bent, loaded)), strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(bent.forward(q, **given), loaded.forward(q, **given))


def test_they_are_the_estimates_own(bent: FittedCalibration, loaded: urdfcal.Calibration) -> None:
    session, problem, state = bent.session, bent.problem, bent.fit.state
    previous = bent.chain.readings(session.came_from)
    expected = problem.joint_values(Readings.of(session), state)
    assert np.abs(expected - session.q).max() > 1e-4
    np.testing.assert_allclose(loaded.joint_values(session.readings, previous=previous), expected, atol=1e-13)
    expected = tip_poses(bent.chain, expected, bent.placements)
    np.testing.assert_allclose(loaded.forward(session.readings, previous=previous), expected, atol=1e-12)
    one = loaded.forward(session.readings[3], previous=previous[3])
    np.testing.assert_allclose(one, expected[3], atol=1e-12)


def test_the_derivative_agrees_with_finite_differences(loaded: urdfcal.Calibration) -> None:
    q = loaded.chain.readings(loaded.chain.random_values(5, np.random.default_rng(0)))
    _, J = loaded.joint_values_with_jacobian(q, previous=q - 0.1)
    for k in range(q.shape[1]):
        step = 1e-5 * np.eye(q.shape[1])[k]
        before, after = (loaded.joint_values(q + sign * step, previous=q - 0.1) for sign in (-1, 1))
        np.testing.assert_allclose(J[..., k], (after - before) / 2e-5, atol=1e-7)


def test_every_parameter_is_in_the_file(bent: FittedCalibration, loaded: urdfcal.Calibration) -> None:
    entries = loaded.to_dict()["joint_models"]
    assert set(entries) == set(bent.chain.actuated)
    assert set(entries["elbow_joint"]) - set(entries["wrist_1_joint"]) == {"motor_harmonics"}
    sag = entries["elbow_joint"]["compliance"]
    assert sag["values"][0] == pytest.approx(3e-5, abs=5 * sag["sigma"][0])
    assert entries["shoulder_lift_joint"]["compliance"]["gain_mm"] > 0.01
    assert entries["elbow_joint"]["motor_harmonics"]["inputs"] == {"gear_ratio": 101.0}
    assert loaded.to_dict()["load"]["payload"]["mass"] == LOAD.mass


def test_a_payload_bends_the_arm(loaded: urdfcal.Calibration) -> None:
    q = loaded.chain.readings(loaded.chain.random_values(20, np.random.default_rng(0)))
    heavy = Payload("tool0", 5.0, LOAD.center)
    same = loaded.joint_values(q, payload=LOAD)
    np.testing.assert_allclose(loaded.joint_values(q), same, atol=1e-15)
    at_frame = urdfcal.Payload(LOAD.link, 2.0)
    centred = replace(at_frame, center=np.zeros(3))
    np.testing.assert_array_equal(loaded.joint_values(q, payload=at_frame), loaded.joint_values(q, payload=centred))
    masses = loaded.joint_models.masses
    place = loaded.chain.tip("tool0")
    torques = masses.carrying(heavy, place).torques(q) - masses.carrying(LOAD, place).torques(q)
    models = loaded.document.joint_models  # the pan joint stands upright: no torque
    c = [models[j]["compliance"].values[0] if "compliance" in models[j] else 0.0 for j in loaded.chain.actuated]
    np.testing.assert_allclose(loaded.joint_values(q, payload=heavy) - same, -torques * c, atol=1e-12)
    unloaded = masses.torques(q) - masses.carrying(LOAD, place).torques(q)
    np.testing.assert_allclose(loaded.joint_values(q, payload="nothing") - same, -unloaded * c, atol=1e-12)
    with pytest.raises(RobotError, match="'wrist' is none of the tip links"):
        loaded.joint_values(q, payload=Payload("wrist", 1.0, np.zeros(3)))


def test_measured_torques_are_needed_where_compliances_were_found_with_them(simulated: Callable) -> None:
    data = simulated("ur5", poses=40)
    rng = np.random.default_rng(0)
    torques = 20.0 * rng.normal(size=data.truth.q.shape)
    session = replace(seen(data, data.truth.q - 5e-5 * torques), torques=torques, joint_models={"compliance": True})
    calibration = calibrate(session, force=True)
    true = calibration.joint_values(session.readings, torques)
    expected = calibration.problem.joint_values(Readings.of(session), calibration.fit.state)
    np.testing.assert_allclose(true, expected, atol=1e-13)
    assert calibration.joint_models.needs_torques
    assert sample_workspace(calibration).moved is None
    with pytest.raises(SessionError, match="these readings have none"):
        calibration.joint_values(session.readings)
    with pytest.raises(RobotError, match="torques of shape"):
        calibration.joint_values(session.readings, torques[:3])
    found = calibration.compensate(session.readings, torques)
    np.testing.assert_allclose(
        calibration.forward(found.q, torques)[:, :3, 3], tip_poses(calibration.chain, session.q)[:, :3, 3], atol=1e-9
    )


@pytest.mark.no_cover
def test_of_an_arm_without_masses_no_payload_is_known(simulated: Callable) -> None:
    (kind,) = (kind for kind in LINEAR if kind.name == "torque_basis")
    session = session_for(kind, simulated)
    calibration = calibrate(session, force=True)
    expected = tip_poses(
        calibration.chain,
        calibration.problem.joint_values(Readings.of(session), calibration.fit.state),
        calibration.problem.arm.placements(calibration.fit.state[ARM]),
    )
    np.testing.assert_allclose(calibration.forward(session.readings), expected, atol=1e-12)
    with pytest.raises(RobotError, match="what a payload does to the arm is not known"):
        calibration.joint_values(session.readings, payload=LOAD)


def test_commands_bring_the_bent_arm_to_the_nominal_pose(loaded: urdfcal.Calibration) -> None:
    q = loaded.chain.readings(loaded.chain.random_values(200, np.random.default_rng(1)))
    given = {"previous": np.roll(q, 1, axis=0), "payload": Payload("tool0", 5.0, np.zeros(3))}
    found = loaded.compensate(q, **given)
    wanted, reached = tip_poses(loaded.chain, q), loaded.forward(found.q, **given)
    distance = np.linalg.norm((wanted - reached)[:, :3, 3], axis=1)
    np.testing.assert_allclose(found.position, distance, atol=1e-12)
    before = np.linalg.norm((wanted - loaded.forward(q, **given))[:, :3, 3], axis=1)
    assert np.median(distance) < 1e-9
    assert np.quantile(distance, 0.95) < 1e-3 * np.median(before)  # beside singularities steps shrink slowly
    rigid = np.linalg.norm((tip_poses(loaded.calibrated, found.q) - wanted)[:, :3, 3], axis=1)
    assert np.median(rigid) > 1e-4  # what a rigid model would have missed
    for k in range(20):
        one = loaded.compensate(q[k], previous=given["previous"][k], payload=given["payload"])
        there = loaded.forward(one.q, previous=given["previous"][k], payload=given["payload"])
        np.testing.assert_allclose(there[:3, 3], reached[k, :3, 3], atol=1e-9)


def test_a_rigid_arms_joints_are_where_they_read(simulated: Callable) -> None:
    calibration = calibrate(replace(simulated("so101").session, joint_models={kind.name: False for kind in LINEAR}))
    assert calibration.to_dict()["joint_models"] == {}
    assert "load" not in calibration.to_dict()
    q = calibration.session.readings
    np.testing.assert_array_equal(calibration.joint_values(q), calibration.session.q)
    np.testing.assert_array_equal(calibration.forward(q), tip_poses(calibration.calibrated, calibration.session.q))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d["joint_models"].update(nobody=d["joint_models"]["elbow_joint"]), "nobody.* is no joint model"),
        (lambda d: d["joint_models"]["elbow_joint"]["lag"].update(values=[0.0, 1.0]), "elbow_joint.lag has 2 values"),
        (lambda d: d.pop("load"), "joint_models, but no load"),
        (lambda d: d["load"]["masses"].pop("elbow_joint"), "load.masses are not those"),
        (lambda d: d["load"]["payload"].update(joint="nobody"), "payload's joint is 'nobody'"),
    ],
)
def test_files_whose_joint_models_make_no_sense_are_refused(
    edit: Callable, message: str, loaded: urdfcal.Calibration, tmp_path: Path
) -> None:
    data = json.loads(loaded.document.to_json())
    edit(data)
    (tmp_path / "calibration.json").write_text(json.dumps(data))
    with pytest.raises(OutputError, match=message):
        urdfcal.Calibration.load(tmp_path)


@pytest.mark.no_cover
def test_the_side_that_a_load_presses_to_is_known_without_the_session(simulated: Callable, tmp_path: Path) -> None:
    session = simulated("ur5", poses=20).session
    on = {kind.name: kind is GravityBacklash for kind in LINEAR}
    found = calibrate(replace(session, joint_models=on), force=True)
    found.save(tmp_path / "calibration.json")
    loaded = urdfcal.Calibration.load(tmp_path)
    expected = found.joint_values(session.readings)
    assert np.abs(expected - session.q).max() > 1e-6
    np.testing.assert_array_equal(loaded.joint_values(session.readings), expected)
