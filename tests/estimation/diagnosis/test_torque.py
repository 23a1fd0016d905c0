from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.estimation.diagnosis.torque import gravity_torques

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.mark.parametrize("rig", ["ur5", "panda", "tiago"])
def test_it_is_the_derivative_of_the_potential_energy(rig: str, simulated: Callable) -> None:
    session = simulated(rig, poses=6).session
    chain, q = session.chain, session.q
    tau = gravity_torques(session, chain, q)
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


def test_without_masses_there_is_none(simulated: Callable) -> None:
    session = simulated("elbow3r", poses=6).session
    assert gravity_torques(replace(session, urdf=None), session.chain, session.q) is None
    weightless = re.sub(rb"<inertial>.*?</inertial>", b"", session.urdf.data, flags=re.DOTALL)
    urdf = replace(session.urdf, data=weightless)
    assert gravity_torques(replace(session, urdf=urdf), session.chain, session.q) is None
