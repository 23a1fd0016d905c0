from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

import urdfcal
from urdfcal.errors import OutputError, RobotError
from urdfcal.robot.dh import DHTable
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture(scope="module", params=["ur5", "so101", "stanford"])
def saved(
    request: pytest.FixtureRequest, fitted: Callable, tmp_path_factory: pytest.TempPathFactory
) -> tuple[urdfcal.FittedCalibration, Path]:
    calibration = fitted(request.param)
    path = tmp_path_factory.mktemp("saved") / "calibration.json"
    calibration.save(path)
    return calibration, path


def test_what_is_loaded_is_what_was_saved(saved: tuple[urdfcal.FittedCalibration, Path], tmp_path: Path) -> None:
    fitted, path = saved
    for loaded in (urdfcal.Calibration.load(path), urdfcal.Calibration.load(path.parent)):
        assert loaded.to_dict() == fitted.to_dict()
        np.testing.assert_array_equal(loaded.placements, fitted.placements)
        np.testing.assert_array_equal(loaded.chain.placements, fitted.chain.placements)
        np.testing.assert_array_equal(loaded.chain.T_last_tip, fitted.chain.T_last_tip)
        assert loaded.chain.names == fitted.chain.names
        for a, b in zip(loaded.chain.joints, fitted.chain.joints, strict=True):
            np.testing.assert_array_equal(a.axis, b.axis)
            assert (a.type, a.lower, a.upper, a.mimic) == (b.type, b.lower, b.upper, b.mimic)
        loaded.save(tmp_path / "again.json")
        assert (tmp_path / "again.json").read_bytes() == path.read_bytes()


def test_the_offsets_give_the_placements(saved: tuple[urdfcal.FittedCalibration, Path]) -> None:
    loaded = urdfcal.Calibration.load(saved[1])
    assert loaded.dh_offsets is not None
    np.testing.assert_array_equal(DHTable.from_chain(loaded.chain).placements(loaded.dh_offsets), loaded.placements)


def test_readings_in_degrees_are_refused(saved: tuple[urdfcal.FittedCalibration, Path]) -> None:
    loaded = urdfcal.Calibration.load(saved[1])
    lower, upper = loaded.chain.limits
    here = np.clip(np.full(len(lower), 0.05), lower, upper)
    beyond = here.copy()
    beyond[0] = upper[0] + 0.05  # as encoders may read
    assert loaded.forward(np.vstack([here, beyond])).shape == (2, 4, 4)
    for wrong in (np.degrees(upper[0]), np.nan):
        readings = np.vstack([here, here])
        readings[1, 0] = wrong
        with pytest.raises(RobotError, match=f"readings, pose 1: {loaded.chain.actuated[0]} = .*radians and metres"):
            loaded.forward(readings)
        with pytest.raises(RobotError, match="previous, pose 1"):
            loaded.joint_values(np.vstack([here, here]), previous=readings)


def test_where_the_arm_comes_from_is_refused_in_degrees_of_commands_too(
    saved: tuple[urdfcal.FittedCalibration, Path],
) -> None:
    loaded = urdfcal.Calibration.load(saved[1])
    here = np.clip(np.full(len(loaded.chain.actuated), 0.05), *loaded.chain.limits)
    for wrong in (np.degrees(loaded.chain.limits[1][0]), np.nan):
        previous = here.copy()
        previous[0] = wrong
        with pytest.raises(RobotError, match="previous, pose 0"):
            loaded.compensate(here, previous=previous)


def test_what_was_measured_beyond_the_limits_is_a_reading(
    saved: tuple[urdfcal.FittedCalibration, Path], tmp_path: Path
) -> None:
    # As calibrate --ignore-limits writes it.
    document = json.loads(saved[1].read_text())
    name, upper = saved[0].chain.actuated[0], float(saved[0].chain.limits[1][0])
    document["domain"]["joints"][name][1] = upper + 2.0
    (tmp_path / "calibration.json").write_text(json.dumps(document))
    readings = np.clip(np.full(len(saved[0].chain.actuated), 0.05), *saved[0].chain.limits)
    readings[0] = upper + 2.05
    assert urdfcal.Calibration.load(tmp_path).forward(readings).shape == (4, 4)
    with pytest.raises(RobotError, match="and what was measured"):
        urdfcal.Calibration.load(saved[1]).forward(readings)


def test_a_loaded_calibration_is_applied_in_place_or_to_a_copy(
    saved: tuple[urdfcal.FittedCalibration, Path],
) -> None:
    fitted, path = saved
    loaded = urdfcal.Calibration.load(path)
    robot = pin.RobotWrapper(pin.buildModelFromXML(fitted.session.urdf.data.decode()))
    drawn = robot.model.copy()
    copy = loaded.apply(robot.model)
    assert robot.model == drawn
    assert loaded.apply(robot.model, in_place=True) is robot.model
    assert robot.model == copy
    built = pin.buildModelFromXML(fitted.calibrated_urdf().decode())
    for a, b in zip(robot.model.jointPlacements, built.jointPlacements, strict=True):
        np.testing.assert_allclose(a.homogeneous, b.homogeneous, atol=1e-12)
    q = pin.neutral(built)
    frame = built.getFrameId(fitted.chain.tip_link)
    robot.framesForwardKinematics(q)  # with the data it was made with
    data = built.createData()
    pin.framesForwardKinematics(built, data, q)
    np.testing.assert_allclose(robot.data.oMf[frame].homogeneous, data.oMf[frame].homogeneous, atol=1e-12)


def test_commands_are_compensated_on_the_calibrated_arm(saved: tuple[urdfcal.FittedCalibration, Path]) -> None:
    loaded = urdfcal.Calibration.load(saved[1])
    actuated = [name in loaded.chain.actuated for name in loaded.chain.names]
    q = loaded.chain.random_values(50, np.random.default_rng(2))
    found = loaded.compensate(q[:, actuated])
    wanted = tip_poses(loaded.chain, q)[:, :3, 3]
    reached = tip_poses(loaded.calibrated, loaded.chain.joint_values(found.q))[:, :3, 3]
    np.testing.assert_allclose(found.position, np.linalg.norm(reached - wanted, axis=1), atol=1e-12)
    assert np.median(found.position) < 1e-8
    one = loaded.compensate(q[0, actuated])
    assert one.q.shape == (len(loaded.chain.actuated),)
    assert one.position.shape == ()


def test_threads_share_a_loaded_calibration(saved: tuple[urdfcal.FittedCalibration, Path]) -> None:
    fitted, path = saved
    drawn = pin.buildModelFromXML(fitted.session.urdf.data.decode())
    q = fitted.session.readings
    expected = urdfcal.Calibration.load(path).compensate(q).q
    loaded = urdfcal.Calibration.load(path)  # what it computes once is computed by whichever thread comes first
    with ThreadPoolExecutor(8) as pool:
        models = list(pool.map(lambda _: loaded.apply(drawn), range(16)))
        commands = list(pool.map(lambda _: loaded.compensate(q).q, range(16)))
    assert all(model == models[0] for model in models)
    for found in commands:
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.update(format="urdfcal/3"), r"'urdfcal/3', not 'urdfcal/2'"),
        (lambda d: d.update(mystery=1), "mystery.*extra inputs"),
        (lambda d: d.pop("leds"), "leds.*field required"),
        (lambda d: d["robot"]["joints"]["elbow_joint"].update(axis=[0, 1]), "elbow_joint.axis"),
        (
            lambda d: d["robot"]["joints"]["elbow_joint"]["calibrated"][0].__setitem__(0, 2.0),
            "calibrated.*no rigid transform",
        ),
        (lambda d: d["dh"][0].update(joint="nobody"), "'nobody', which the robot has not"),
        (lambda d: d["T_world_base"][0].__setitem__(3, float("nan")), "NaN is no number"),
    ],
)
def test_files_that_are_no_result_are_refused(edit: Callable, message: str, fitted: Callable, tmp_path: Path) -> None:
    document = fitted("ur5").to_dict()
    edit(document)
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(document))
    with pytest.raises(OutputError, match=message):
        urdfcal.Calibration.load(path)


def test_files_that_are_not_there_say_so(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No such file"):
        urdfcal.Calibration.load(tmp_path)
    (tmp_path / "calibration.json").write_text("{")
    with pytest.raises(OutputError, match="no JSON"):
        urdfcal.Calibration.load(tmp_path)
