from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

import urdfcal
from urdfcal.calibration import calibrate
from urdfcal.errors import OutputError, RobotError
from urdfcal.estimation.evaluation import compare
from urdfcal.robot.chain import Chain
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.urdf import Urdf
from urdfcal.session.files import read_session

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

RIGS = ["elbow3r", "ur5", "panda", "so101", "stanford"]


def error(calibration: urdfcal.Calibration, simulated: object, placements: np.ndarray) -> float:
    """Rms distance of a robot's tip from the true one's over the workspace. [m]"""
    chain = calibration.chain
    q = chain.random_values(300, np.random.default_rng(0))
    true, other = (replace(chain, placements=p) for p in (simulated.truth.placements, placements))
    return float(np.sqrt(np.mean(compare(true, other, q).position ** 2)))


@pytest.mark.parametrize("rig", RIGS)
def test_the_calibrated_arm_is_far_nearer_to_the_true_one(rig: str, simulated: Callable) -> None:
    data = simulated(rig, poses=50)
    calibration = calibrate(data.session)
    assert error(calibration, data, calibration.placements) < 0.25 * error(
        calibration, data, calibration.chain.placements
    )


@pytest.mark.parametrize("rig", RIGS)
def test_the_corrected_urdf_is_the_drawn_one_but_for_origins(rig: str, simulated: Callable) -> None:
    data = simulated(rig)
    calibration = calibrate(data.session)
    drawn, built = data.session.urdf.data, calibration.calibrated_urdf()
    masked = [re.sub(rb"<origin[^>]*>", lambda tag: re.sub(rb'"[^"]*"', b"", tag[0]), text) for text in (drawn, built)]
    assert masked[0] == masked[1]
    chain = Chain.from_urdf(Urdf.parse(built), calibration.chain.tip_link, calibration.chain.base_link)
    q = chain.random_values(50, np.random.default_rng(1))
    expected = tip_poses(calibration.chain, q, calibration.placements)
    np.testing.assert_allclose(tip_poses(chain, q), expected, atol=1e-12)


def test_apply_gives_the_corrected_urdfs_kinematics(simulated: Callable) -> None:
    data = simulated("panda")
    calibration = calibrate(data.session)
    drawn = pin.buildModelFromXML(data.session.urdf.data.decode())
    kept = drawn.copy()
    applied = calibration.apply(drawn)
    assert drawn == kept
    written = pin.buildModelFromXML(calibration.calibrated_urdf().decode())
    for a, b in zip(applied.jointPlacements, written.jointPlacements, strict=True):
        np.testing.assert_allclose(a.homogeneous, b.homogeneous, atol=1e-12)


def test_apply_refuses_another_robot_and_a_second_time(simulated: Callable) -> None:
    data = simulated("panda")
    calibration = calibrate(data.session)
    drawn = pin.buildModelFromXML(data.session.urdf.data.decode())
    with pytest.raises(RobotError, match="not the one that was calibrated"):
        calibration.apply(calibration.apply(drawn))
    with pytest.raises(RobotError, match="no joint 'panda_joint1'"):
        calibration.apply(pin.buildSampleModelManipulator())


def test_a_session_without_urdf_still_has_a_model(simulated: Callable) -> None:
    session = simulated("elbow3r").session
    calibration = calibrate(replace(session, urdf=None))
    with pytest.raises(OutputError, match="without a URDF"):
        calibration.calibrated_urdf()
    assert calibration.apply(calibration.chain.build_model()).njoints == 4


def test_the_result_does_not_depend_on_where_the_base_link_is(simulated: Callable) -> None:
    # The same measurements with the chain rooted one fixed joint further down, at UR's turned `base` frame.
    session = simulated("ur5").session
    other = replace(session, chain=Chain.from_urdf(session.urdf, "tool0", "world"))
    a, b = calibrate(session), calibrate(other)
    np.testing.assert_allclose(a.placements[1:], b.placements[1:], atol=1e-9)


def test_json_says_what_was_estimated_and_why_not(simulated: Callable) -> None:
    data = simulated("ur5")
    calibration = calibrate(data.session, seed=7)
    result = json.loads(json.dumps(calibration.to_dict(), allow_nan=False))
    assert result["format"] == "urdfcal/1"
    assert result["provenance"]["seed"] == 7
    assert set(result["placements"]) == set(calibration.chain.names)
    assert len(result["dh"]) == 5 * 6
    for row in result["dh"]:
        assert row["unit"] == ("m" if row["parameter"] in ("d", "a") else "rad")
        if row["status"] == "estimated":
            assert row["sigma"] > 0.0
        else:
            assert row["status"] == "fixed"
            assert row["reason"]
            assert row["offset"] == 0.0
    assert sum(row["status"] == "estimated" for row in result["dh"]) == 18
    assert result["fit"]["parameters"] == result["fit"]["rank"] == 27
    assert result["fit"]["rms_px"] < 0.2 < result["fit"]["rms_nominal_px"]
    assert 0.5 < result["fit"]["reduced_chi2"] < 1.6


def test_tolerances_of_zero_hold_a_parameter(simulated: Callable) -> None:
    session = simulated("ur5").session
    held = replace(session, tolerances=replace(session.tolerances, joints={"elbow_joint": {"alpha": 0.0}}))
    row = next(
        row for row in calibrate(held).to_dict()["dh"] if row["joint"] == "elbow_joint" and row["parameter"] == "alpha"
    )
    assert (row["status"], row["offset"]) == ("fixed", 0.0)
    assert "tolerances" in row["reason"]


def test_cameras_of_unknown_place_are_placed(simulated: Callable) -> None:
    data = simulated("ur5", poses=50)
    rig = data.session.rig
    unknown = replace(data.session, rig=replace(rig, T_cam_world=(rig.T_cam_world[0], None)))
    calibration = calibrate(unknown)
    np.testing.assert_allclose(calibration.estimate.T_cam_world[1], rig.T_cam_world[1], atol=5e-3)
    # Without a baseline nothing but the links' lengths tells the scale: no rank for it, and it is said.
    assert calibration.identifiability.rank == 27 + 6 - 1
    assert any("tolerances share it out" in lost for lost in calibration.identifiability.lost)
    assert error(calibration, data, calibration.placements) < 0.6 * error(
        calibration, data, calibration.chain.placements
    )


def test_the_measured_irb120_comes_out_as_published(shared: Path) -> None:
    fit = calibrate(read_session(shared / "irb120_liaowu")).summary()
    assert fit["rms_nominal_mm"] == pytest.approx(5.33, abs=0.01)
    assert fit["rms_mm"] <= 0.25


def test_every_exported_name_is_there() -> None:
    for name in urdfcal.__all__:
        assert getattr(urdfcal, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        urdfcal.nonsense  # noqa: B018
