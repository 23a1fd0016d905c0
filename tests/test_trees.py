"""Robots that branch, eye-in-hand cameras: from a session to a corrected URDF and back."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from tests.states import at_joint_values
from urdfcal.errors import CalibrationError, RobotError
from urdfcal.pipeline import calibrate
from urdfcal.result.calibration import Calibration
from urdfcal.robot.chain import Tree, read_mechanism
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.session.attachments import CameraMount
from urdfcal.session.knowledge import Estimate, Led

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.simulation.truth import Simulated

TREES = ["tiago", "tiago_dual", "ur5_handeye"]


@pytest.fixture(scope="module")
def calibrated(simulated: Callable, fitted: Callable) -> Callable[[str], tuple[Simulated, FittedCalibration]]:
    return lambda rig: (simulated(rig, poses=40), fitted(rig, poses=40))


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", TREES)
def test_new_poses_are_predicted(rig: str, calibrated: Callable, simulated: Callable, true_state: Callable) -> None:
    """Where the cameras should see the LEDs at poses of the same robot that calibration has not seen."""
    data, calibration = calibrated(rig)
    (observed,) = calibration.observations
    q = data.session.chain.random_values(len(observed.pose), np.random.default_rng(5))
    problem, elsewhere = calibration.problem, at_joint_values(observed, q)
    truth = problem.predict(elsewhere, true_state(data))
    errors = [
        np.linalg.norm(problem.predict(elsewhere, fit.state) - truth, axis=-1)
        for fit in (calibration.nominal_fit, calibration.fit)
    ]
    seen = np.isfinite(errors).all(axis=0) & (np.abs(truth) < 2000).all(axis=-1)
    before, after = (np.median(error[seen]) for error in errors)
    assert after < 0.2 * before


@pytest.mark.parametrize("rig", TREES)
def test_the_file_has_it_all_and_reads_back(rig: str, calibrated: Callable, tmp_path: Path) -> None:
    data, calibration = calibrated(rig)
    calibration.save(tmp_path / "calibration.json")
    loaded = Calibration.load(tmp_path)
    assert type(loaded.chain) is type(calibration.chain)
    assert loaded.chain.parents == calibration.chain.parents
    np.testing.assert_array_equal(loaded.placements, calibration.placements)
    np.testing.assert_array_equal(loaded.dh_offsets, calibration.estimate.offsets)
    document = json.loads((tmp_path / "calibration.json").read_text())
    fixed = not len(data.session.attachments.eye_to_hand)
    assert all((sigma is None) == fixed for sigma in document["T_world_base_sigma"])
    for name, mount in ((mount.camera, mount) for mount in data.session.mounts):
        camera = document["cameras"][name]
        assert camera["link"] == mount.link
        c = data.session.rig.index(name)
        T = np.array(camera["T_link_camera"]) @ data.truth.T_cam_frame[c]
        sigma = np.array(camera["sigma"]["T_link_camera"], dtype=float)
        assert np.all(np.abs(pin.log6(T).vector) < 6.0 * sigma + 1e-3)


@pytest.mark.parametrize("rig", TREES)
def test_the_corrected_urdf_and_an_applied_model_move_alike(rig: str, calibrated: Callable) -> None:
    data, calibration = calibrated(rig)
    urdf, chain = data.session.urdf, calibration.chain
    written = read_mechanism(Urdf.parse(calibration.calibrated_urdf()), [t.link for t in chain.tips], chain.base_link)
    q = chain.random_values(20, np.random.default_rng(0))
    expected = link_poses(chain, q, chain.tips, calibration.placements)
    for found, wanted in zip(link_poses(written, q, written.tips), expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-12)
    whole = pin.buildModelFromXML(urdf.data.decode())
    applied = calibration.apply(whole)
    reference = pin.buildModelFromXML(calibration.calibrated_urdf().decode())
    for a, b in zip(applied.jointPlacements, reference.jointPlacements, strict=True):
        np.testing.assert_allclose(a.homogeneous, b.homogeneous, atol=1e-12)
    with pytest.raises(RobotError, match="already has its calibrated placement"):
        calibration.apply(applied)


def test_a_locked_torso_carries_both_arms(calibrated: Callable) -> None:
    data, calibration = calibrated("tiago_dual")
    assert isinstance(calibration.chain, Tree)
    nominal = pin.buildModelFromXML(data.session.urdf.data.decode())
    calibrated_model = pin.buildModelFromXML(calibration.calibrated_urdf().decode())
    at = pin.neutral(nominal)
    locked = [nominal.getJointId(name) for name in ("torso_lift_joint", "arm_left_2_joint")]
    applied, reference = (pin.buildReducedModel(model, locked, at) for model in (nominal, calibrated_model))
    calibration.apply(applied, in_place=True)
    for a, b in zip(applied.jointPlacements, reference.jointPlacements, strict=True):
        np.testing.assert_allclose(a.homogeneous, b.homogeneous, atol=1e-12)


def test_what_is_unidentifiable_is_named(calibrated: Callable) -> None:
    _, head = calibrated("tiago")
    text = "\n".join(head.identifiability.unidentifiable)
    assert "d of row 1 (torso_lift_joint) moves nothing that is measured" in text
    assert "the scale (all lengths together" in text
    assert "theta of row 11 (head_2_joint) cannot be distinguished from where head is attached" in text
    _, hand = calibrated("ur5_handeye")
    text = "\n".join(hand.identifiability.unidentifiable)
    assert "theta of row 6 (wrist_3_joint) cannot be distinguished from where hand is attached" in text


def test_an_eye_in_hand_camera_is_placed_by_itself(simulated: Callable) -> None:
    """Nothing said of its pose: PnP on the LEDs' rough positions, seen from its link."""
    data = simulated("ur5_handeye", poses=40)
    session = replace(data.session, mounts=(CameraMount("hand", "tool0"),), estimate=Estimate("dh", "fixed"))
    calibration = calibrate(session)
    T = calibration.estimate.T_cam_frame[0] @ np.linalg.inv(data.truth.T_cam_frame[0])
    assert np.linalg.norm(pin.log6(T).linear) < 0.01
    assert np.sqrt(calibration.fit.reduced_chi2) < 1.2


def test_leds_of_unknown_position_are_put_where_rays_meet(simulated: Callable) -> None:
    data = simulated("ur5_handeye", poses=40)
    leds = tuple(Led(led.name, link="world") for led in data.session.leds)
    calibration = calibrate(replace(data.session, leds=leds, estimate=Estimate("dh", "fixed")))
    np.testing.assert_allclose(calibration.estimate.leds, data.truth.leds, atol=0.01)


def test_neither_camera_nor_led_of_known_position_is_too_little(simulated: Callable) -> None:
    data = simulated("ur5_handeye", poses=40)
    leds = tuple(Led(led.name, link="world") for led in data.session.leds)
    session = replace(data.session, leds=leds, mounts=(CameraMount("hand", "tool0"),))
    with pytest.raises(CalibrationError, match="'hand' has only 0 detections of LEDs whose position is roughly known"):
        calibrate(session)
