from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.errors import RobotError
from urdfcal.robot.gravity import masses_of
from urdfcal.robot.kinematics import tip_poses
from urdfcal.session.knowledge import Payload

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.mark.parametrize("rig", ["ur5", "panda", "tiago"])
def test_it_is_the_derivative_of_the_potential_energy(rig: str, simulated: Callable) -> None:
    session = simulated(rig, poses=6).session
    chain, q = session.chain, session.q
    tau = masses_of(session.urdf, chain).torques(q)
    model = pin.buildModelFromXML(session.urdf.data.decode())
    data = model.createData()

    def energy(values: np.ndarray) -> float:
        configuration = pin.neutral(model)
        for name, value in zip(chain.names, values, strict=True):
            joint = model.joints[model.getJointId(name)]
            configuration[joint.idx_q : joint.idx_q + joint.nq] = (
                [np.cos(value), np.sin(value)] if joint.nq == 2 else [value]
            )
        return float(pin.computePotentialEnergy(model, data, configuration))

    assert np.abs(tau).max() > 1.0
    for j in range(len(chain.names)):
        step = 1e-5 * np.eye(len(chain.names))[j]
        numeric = (energy(q[2] + step) - energy(q[2] - step)) / 2e-5
        assert tau[2, j] == pytest.approx(numeric, abs=1e-5 * np.abs(tau).max())


@pytest.mark.parametrize(
    ("mass", "center", "message"),
    [
        (2000.0, 0.06, r"payload: a payload of 2000 kg is no load of an arm whose links weigh \d.*grams"),
        (2.0, 60.0, r"payload: its centre is 60 m from tool0, the arm reaches .*millimetres"),
        (2.0, 0.06, None),
    ],
)
def test_a_payload_in_grams_or_millimetres_is_refused(
    mass: float, center: float, message: str | None, simulated: Callable
) -> None:
    session = simulated("ur5", poses=6).session
    payload = Payload("tool0", mass, np.array([0.0, 0.0, center]))
    if message is None:
        own, with_it = (masses_of(session.urdf, session.chain, of).mass.sum() for of in (None, payload))
        assert with_it == pytest.approx(own + mass)
        return
    with pytest.raises(RobotError, match=message):
        masses_of(session.urdf, session.chain, payload)


def test_without_masses_there_is_none(simulated: Callable) -> None:
    session = simulated("elbow3r", poses=6).session
    weightless = re.sub(rb"<inertial>.*?</inertial>", b"", session.urdf.data, flags=re.DOTALL)
    assert masses_of(replace(session.urdf, data=weightless), session.chain) is None


def test_a_robot_on_a_wall_is_one_that_was_turned_with_its_gravity(simulated: Callable) -> None:
    # A first joint along gravity, turned until gravity pulls across it.
    session = simulated("ur5", poses=6).session
    masses = masses_of(session.urdf, session.chain)
    upright, wall = masses.torques(session.q), masses.torques(session.q, np.array([9.81, 0.0, 0.0]))
    np.testing.assert_allclose(upright[:, 0], 0.0, atol=1e-12)
    assert np.abs(wall[:, 0]).max() > 1.0
    np.testing.assert_allclose(masses.torques(session.q, np.zeros(3)), 0.0, atol=1e-12)


def test_a_payload_pulls_where_it_is(simulated: Callable) -> None:
    @dataclass(frozen=True)
    class Box:
        link: str
        mass: float
        center: np.ndarray = field(compare=False)

    session = simulated("ur5", poses=6).session
    chain, centre = session.chain, np.array([0.02, 0.05, 0.1])
    with_box = masses_of(session.urdf, chain, Box("tool0", 3.0, centre))
    added = with_box.torques(session.q) - masses_of(session.urdf, chain).torques(session.q)
    for q, tau in zip(session.q, added, strict=True):
        for j in range(len(chain.names)):
            step = 1e-6 * np.eye(len(chain.names))[j]
            height = [(T[:3, :3] @ centre + T[:3, 3])[2] for T in tip_poses(chain, np.array([q + step, q - step]))]
            assert tau[j] == pytest.approx(3.0 * 9.81 * (height[0] - height[1]) / 2e-6, abs=1e-5)
