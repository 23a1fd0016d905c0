"""A calibrated model drops into Pink: its inverse kinematics takes the true arm to its targets."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pink
import pinocchio as pin
import pytest

if TYPE_CHECKING:
    from collections.abc import Callable

TARGETS = 20


def solve(model: pin.Model, tip: str, target: pin.SE3, start: np.ndarray) -> np.ndarray:
    """Joint values that take a model's tip to a target, by Pink."""
    configuration = pink.Configuration(model, model.createData(), start)
    task = pink.FrameTask(tip, position_cost=1.0, orientation_cost=1.0)
    task.set_target(target)
    for _ in range(200):
        if np.linalg.norm(task.compute_error(configuration)) < 1e-9:
            break
        velocity = pink.solve_ik(configuration, [task], 0.1, solver="daqp", damping=1e-12, safety_break=False)
        configuration.integrate_inplace(velocity, 0.1)
    assert np.linalg.norm(task.compute_error(configuration)) < 1e-6
    return configuration.q


@pytest.mark.parametrize("rig", ["ur5", "panda"])
def test_the_true_arm_meets_the_targets_as_well_as_it_is_known(rig: str, simulated: Callable, fitted: Callable) -> None:
    data, calibration = simulated(rig, poses=50), fitted(rig, poses=50)
    tip = calibration.chain.tip_link
    robot = pin.RobotWrapper(pin.buildModelFromXML(data.session.urdf.data.decode()))
    nominal, true = robot.model.copy(), pin.buildModelFromXML(data.truth.urdf.decode())
    calibration.apply(robot.model, in_place=True)
    pin.seed(1)
    rng = np.random.default_rng(1)
    misses: dict[str, list[float]] = {"nominal": [], "calibrated": [], "model": []}
    for k in range(TARGETS):
        # Measured poses are in front of the cameras and free of collisions; targets are where the drawing puts them.
        pose = pin.neutral(nominal)
        for name, value in zip(calibration.chain.names, data.session.q[k], strict=True):
            pose[nominal.joints[nominal.getJointId(name)].idx_q] = value
        target = place(nominal, tip, pose)
        start = pin.integrate(nominal, pose, rng.uniform(-0.1, 0.1, nominal.nv))
        start = np.clip(start, nominal.lowerPositionLimit, nominal.upperPositionLimit)
        for name, model in (("nominal", nominal), ("calibrated", robot.model)):
            q = solve(model, tip, target, start)
            misses[name].append(float(np.linalg.norm(place(true, tip, q).translation - target.translation)))
        misses["model"].append(
            float(np.linalg.norm(place(true, tip, q).translation - place(robot.model, tip, q).translation))
        )
    rms = {name: np.sqrt(np.mean(np.square(values))) for name, values in misses.items()}
    assert rms["calibrated"] == pytest.approx(rms["model"], rel=0.05)
    assert rms["calibrated"] < 0.3e-3
    assert rms["calibrated"] < 0.2 * rms["nominal"]


def place(model: pin.Model, frame: str, q: np.ndarray) -> pin.SE3:
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(frame)].copy()
