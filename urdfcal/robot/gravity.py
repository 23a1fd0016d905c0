"""Joint torques that hold a robot against gravity, from the inertials of its URDF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.robot.flexure import rigid_joints, without_flexures
from urdfcal.robot.kinematics import Buffers
from urdfcal.robot.mechanism import BASE, Tip

if TYPE_CHECKING:
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.urdf import Urdf

STANDARD_GRAVITY = frozen(np.array([0.0, 0.0, -9.81]))
"""Of a robot that stands upright, in its base link's frame. [m/s^2]"""
# No arm carries so many times its own weight: a UR5 5 of 18 kg, an SO-101 0.3 of 0.6. Grams are a thousand times more.
_HEAVIER = 2.0


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

    Attributes:
        mechanism: the joints, as drawn.
        mass: (n,) of each joint's links. [kg]
        center: (n, 3) their centre of mass in the joint's frame. [m]
    """

    mechanism: Mechanism
    mass: Floats
    center: Floats

    def __post_init__(self) -> None:
        for name in ("mass", "center"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def carrying(self, body: Body, at: Tip) -> Masses:
        """Return the same with a body on a link of a joint; what is on the base link is carried by none.

        Raises:
            RobotError: the body is heavier than the arm could carry, or its centre is out of the arm's reach.
        """
        own, away = float(np.sum(self.mass)), float(np.linalg.norm(body.center))
        if own > 0.0 and body.mass > _HEAVIER * own:
            what = f"a payload of {body.mass:.4g} kg is no load of an arm whose links weigh {own:.3g} kg"
            raise RobotError(what, where="payload", remedy="Masses are in kg; this looks like grams.")
        if away > self.mechanism.reach:
            what = f"its centre is {away:.4g} m from {body.link}, the arm reaches {self.mechanism.reach:.2g} m"
            raise RobotError(what, where="payload", remedy="Coordinates are in metres; these look like millimetres.")
        if at.joint == BASE:
            return self
        mass, center = np.array(self.mass), np.array(self.center)
        total = mass[at.joint] + body.mass
        place = at.T_joint_link[:3, :3] @ body.center + at.T_joint_link[:3, 3]
        center[at.joint] = (mass[at.joint] * center[at.joint] + body.mass * place) / total if total else 0.0
        mass[at.joint] = total
        return Masses(self.mechanism, mass, center)

    def on(self, mechanism: Mechanism) -> Masses:
        """Return the same on the same joints of a mechanism that has flexures beside them, which carry nothing."""
        real, count = rigid_joints(mechanism), len(mechanism.joints)
        if len(real) == count:
            return self
        mass, center = np.zeros(count), np.zeros((count, 3))
        mass[real], center[real] = self.mass, self.center
        return Masses(mechanism, mass, center)

    def torques(self, q: Floats, gravity: Floats = STANDARD_GRAVITY) -> Floats:
        """Compute the torques or forces that hold the joints against gravity.

        Args:
            q: (N, n) joint values. [rad or m]
            gravity: (3,) in the base link's frame. [m/s^2]

        Returns:
            (N, n) along each joint's axis. [N m or N]
        """
        tau = np.empty(q.shape)
        with self._buffers as (model, data):
            model.gravity.linear = np.array(gravity)
            for k, values in enumerate(q):
                tau[k] = pin.computeGeneralizedGravity(model, data, values)
        return tau

    def slopes(self, q: Floats, gravity: Floats = STANDARD_GRAVITY) -> Floats:
        """Compute the derivatives (N, n, n) of :meth:`torques` by the joint values. [N m/rad, N/m]."""
        found = np.empty((*q.shape, q.shape[1]))
        with self._buffers as (model, data):
            model.gravity.linear = np.array(gravity)
            for k, values in enumerate(q):
                found[k] = pin.computeGeneralizedGravityDerivatives(model, data, values)
        return found

    @cached_property
    def _buffers(self) -> Buffers:
        model = self.mechanism.build_model()
        for k, (mass, center) in enumerate(zip(self.mass, self.center, strict=True), start=1):
            model.inertias[k] = pin.Inertia(float(mass), np.array(center), np.zeros((3, 3)))
        return Buffers(model)


def masses_of(urdf: Urdf, mechanism: Mechanism, payload: Body | None = None) -> Masses | None:
    """Read the masses that a mechanism's joints carry; None where the URDF and the payload have none.

    Joints of the URDF that are none of the mechanism's stay at their neutral position.

    Args:
        urdf: the robot.
        mechanism: some of its joints.
        payload: what the robot carries beside its own links.
    """
    drawn = without_flexures(mechanism)
    model = _reduced(urdf, drawn)
    if model is None:
        return None
    inertias = [model.inertias[model.getJointId(name)] for name in drawn.names]
    mass = np.array([inertia.mass for inertia in inertias])
    center = np.array([inertia.lever if inertia.mass > 0.0 else np.zeros(3) for inertia in inertias])
    found = Masses(drawn, mass, center).on(mechanism)
    if payload is not None:
        found = found.carrying(payload, place_of(urdf, mechanism, payload.link))
    return found if np.any(found.mass > 0.0) else None


def place_of(urdf: Urdf, mechanism: Mechanism, link: str) -> Tip:
    """Find the joint of a mechanism that carries a link of the URDF, and the link's frame in that joint's."""
    model = _reduced(urdf, without_flexures(mechanism))
    if model is None or not model.existFrame(link):
        return mechanism.tip(link)
    frame = model.frames[model.getFrameId(link)]
    joint = mechanism.names.index(model.names[frame.parentJoint]) if frame.parentJoint else BASE
    return Tip(link, joint, frame.placement.homogeneous)


@lru_cache(maxsize=8)
def _reduced(urdf: Urdf, mechanism: Mechanism) -> pin.Model | None:
    """The URDF's model with the mechanism's joints alone; None where it has not got them all."""
    model = pin.buildModelFromXML(urdf.text)
    if not all(model.existJointName(name) for name in mechanism.names) or not model.existFrame(mechanism.base_link):
        return None
    others = [k for k, name in enumerate(model.names) if k and name not in mechanism.names]
    return pin.buildReducedModel(model, others, pin.neutral(model))


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
