"""Joint torques that hold a robot against gravity, from the inertials of its URDF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, Ints, frozen

if TYPE_CHECKING:
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.urdf import Urdf

STANDARD_GRAVITY = frozen(np.array([0.0, 0.0, -9.81]))
"""Of a robot that stands upright, in its base link's frame. [m/s^2]"""


class Body(Protocol):
    """Something heavy on a link, as a payload: its link, its mass [kg] and its centre (3,) in the link's frame [m]."""

    @property
    def link(self) -> str:
        """The link that carries it."""

    @property
    def mass(self) -> float:
        """Its mass. [kg]."""

    @property
    def center(self) -> Floats:
        """(3,) its centre of mass in the link's frame. [m]."""


@dataclass(frozen=True, eq=False)
class Masses:
    """The masses that the joints of a mechanism carry.

    Joints of the URDF that are none of the mechanism's stay at their neutral position.

    Attributes:
        model: of these joints alone, with all masses.
        joint: (n,) index of each of the mechanism's joints in the model.
        R_root_base: (3, 3) the base link's rotation in the model's root frame.
    """

    model: pin.Model
    joint: Ints
    R_root_base: Floats

    def torques(self, q: Floats, gravity: Floats = STANDARD_GRAVITY) -> Floats:
        """Compute the torques or forces that hold the joints against gravity.

        Args:
            q: (N, n) joint values. [rad or m]
            gravity: (3,) in the base link's frame. [m/s^2]

        Returns:
            (N, n) along each joint's axis. [N m or N]
        """
        model = self.model.copy()
        model.gravity.linear = self.R_root_base @ gravity
        joints = [model.joints[int(k)] for k in self.joint]
        configurations = np.zeros((len(q), model.nq))
        for values, joint in zip(q.T, joints, strict=True):
            if joint.nq == 2:  # continuous
                configurations[:, joint.idx_q], configurations[:, joint.idx_q + 1] = np.cos(values), np.sin(values)
            else:
                configurations[:, joint.idx_q] = values
        data, tau = model.createData(), np.zeros((len(q), model.nv))
        for k, configuration in enumerate(configurations):
            tau[k] = pin.computeGeneralizedGravity(model, data, configuration)
        return tau[:, [joint.idx_v for joint in joints]]


@lru_cache(maxsize=8)
def masses_of(urdf: Urdf, mechanism: Mechanism, payload: Body | None = None) -> Masses | None:
    """Read the masses that a mechanism's joints carry; None where the URDF and the payload have none.

    Args:
        urdf: the robot.
        mechanism: some of its joints.
        payload: what the robot carries beside its own links.
    """
    model = pin.buildModelFromXML(urdf.text)
    if not all(model.existJointName(name) for name in mechanism.names) or not model.existFrame(mechanism.base_link):
        return None
    if payload is not None:
        frame = model.frames[model.getFrameId(payload.link)]
        inertia = pin.Inertia(payload.mass, np.array(payload.center), np.zeros((3, 3)))
        model.appendBodyToJoint(frame.parentJoint, inertia, frame.placement)
    others = [k for k, name in enumerate(model.names) if k and name not in mechanism.names]
    neutral = pin.neutral(model)
    data = model.createData()
    pin.framesForwardKinematics(model, data, neutral)
    R_root_base = data.oMf[model.getFrameId(mechanism.base_link)].rotation.copy()
    model = pin.buildReducedModel(model, others, neutral)
    if not any(inertia.mass > 0.0 for inertia in list(model.inertias)[1:]):
        return None
    joint = np.array([model.getJointId(name) for name in mechanism.names])
    return Masses(model, frozen(joint, np.intp), frozen(R_root_base))


def torque_regressor(mechanism: Mechanism, q: Floats, gravity: Floats = STANDARD_GRAVITY) -> Floats:
    """Compute the derivative of the torques at rest by the masses and first moments of the links.

    Args:
        mechanism: the joints.
        q: (N, n) joint values. [rad or m]
        gravity: (3,) in the base link's frame. [m/s^2]

    Returns:
        (N, k, 4 n) for each joint with a reading by mass and first moments (3,) of each joint's links. [m/s^2, 1/s^2]
    """
    model, rest = mechanism.build_model(), np.zeros(len(mechanism.joints))
    model.gravity.linear = np.array(gravity)
    data, found = model.createData(), np.zeros((len(q), len(rest), 4 * len(rest)))
    columns = (10 * np.arange(len(rest))[:, None] + np.arange(4)).ravel()
    for k, values in enumerate(q):
        found[k] = pin.computeJointTorqueRegressor(model, data, values, rest, rest)[:, columns]
    result: Floats = np.einsum("ij,niq->njq", mechanism.reading_jacobian, found)
    return result
