"""Joint models with their estimated parameters, at readings that they were not estimated from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np

from urdfcal.arrays import frozen
from urdfcal.errors import RobotError
from urdfcal.estimation.joint_models.base import Readings
from urdfcal.estimation.joint_models.bending import Bending
from urdfcal.estimation.joint_models.linear import LinearJointModel, Setting
from urdfcal.estimation.joint_models.torque_basis import TorqueBasis
from urdfcal.estimation.joint_models.under_torque import UnderTorque
from urdfcal.robot.flexure import without_flexures
from urdfcal.robot.gravity import place_of
from urdfcal.robot.newton import AsTold
from urdfcal.session.trajectory import AT_REST, Trajectory

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.linear import OneCommand
    from urdfcal.robot.gravity import Body, Masses
    from urdfcal.robot.mechanism import Mechanism, Tip
    from urdfcal.session.knowledge import Payload
    from urdfcal.session.model import Session

Carried: TypeAlias = "Payload | Literal['nothing'] | None"
"""What an arm carries; None for what it carried when it was calibrated."""


# Of a single pose, its number and that of its part of the session.
_FIRST = frozen(np.zeros(1, dtype=np.intp))


class FoundModel(NamedTuple):
    """A joint model that was estimated.

    Attributes:
        kind: its class.
        joints: names of those that have it, in the mechanism's order.
        values: (k,) of their parameters.
        inputs: of each joint, what ``kind.again`` needs.
    """

    kind: type[LinearJointModel]
    joints: tuple[str, ...]
    values: Floats
    inputs: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True, eq=False)
class FoundJointModels:
    """All joint models of a calibrated arm.

    Attributes:
        mechanism: the joints, as drawn, and flexures where links bend.
        found: what was estimated; nothing of a rigid arm.
        gravity: (3,) in the base link's frame. [m/s^2]
        masses: of the arm without payload; None where torques are measured, or nobody knows.
        payload: what the arm carried.
        places: where links are that a payload may be on, beside the mechanism's tips.
    """

    mechanism: Mechanism
    found: tuple[FoundModel, ...]
    gravity: Floats
    masses: Masses | None = None
    payload: Body | None = None
    places: tuple[Tip, ...] = ()

    @property
    def bending(self) -> tuple[str, ...]:
        """Names of the joints before which links bend."""
        return next((of.joints for of in self.found if of.kind is Bending), ())

    @property
    def needs_torques(self) -> bool:
        """Whether a model is that under measured torques, which nobody knows where they were not measured."""
        return any(isinstance(of, UnderTorque) and not of.masses for of in self.models)

    def carrying(self, carried: Payload | Literal["nothing"]) -> FoundJointModels:
        """Return the same of an arm that carries something else, or nothing.

        Raises:
            RobotError: nothing is known of the payload's link, or of the arm's masses.
        """
        return _carrying(self, carried)

    def under(self, session: Session) -> FoundJointModels:
        """Return the same of an arm that stands and carries what it does in a session; of parts, in the first.

        Raises:
            RobotError: nothing is known of the arm's masses, and it carries something.
        """
        payload, urdf = (session.payloads or (session.payload,))[0], session.urdf
        at = () if payload is None or urdf is None else (place_of(urdf, self.mechanism, payload.link),)
        changed = replace(self, gravity=session.gravity, payload=payload, places=at)
        _ = changed.models
        return changed

    @cached_property
    def models(self) -> tuple[LinearJointModel, ...]:
        """The joint models."""
        places = {tip.link: tip for tip in self.places}
        payload = self.payload
        place = None if payload is None else places.get(payload.link) or self.mechanism.tip(payload.link)
        return self._under(self.gravity, ((payload, place),))

    @property
    def values(self) -> dict[Any, Floats]:
        """The models' parameters, by their keys in a state."""
        return {of.kind.key_of(): of.values for of in self.found}

    def of_session(self, session: Session) -> tuple[LinearJointModel, ...]:
        """Return the models under a session's gravity and payloads; of a moving arm those that concern it.

        Raises:
            RobotError: the session has other joints.
        """
        drawn = without_flexures(self.mechanism)
        if self.found and session.chain.names != drawn.names:
            raise RobotError(
                f"joint models were found of {', '.join(drawn.names)}, the session's joints are "
                f"{', '.join(session.chain.names)}",
                remedy="Name a session with the same base link and tip links.",
            )
        payloads = session.payloads or (session.payload,) * len(session.parts)
        urdf, chain = session.urdf, self.mechanism
        carried = tuple((p, place_of(urdf, chain, p.link) if p and urdf else None) for p in payloads)
        models = self._under(session.gravity, carried)
        return tuple(m for m in models if not (m.at_rest and isinstance(session.motion, Trajectory)))

    def _under(self, gravity: Floats, carried: tuple[tuple[Body | None, Tip | None], ...]) -> tuple[Any, ...]:
        if any(payload for payload, _ in carried) and any(of.kind is TorqueBasis for of in self.found):
            raise RobotError(
                "what a payload does to the arm is not known: its URDF has no masses",
                where="payload",
                remedy="Calibrate with that payload, or with a URDF that has <inertial> elements, and leave it out.",
            )
        each = () if self.masses is None else carried
        masses = tuple(self.masses.carrying(p, at) if p and at else self.masses for p, at in each if self.masses)
        setting = Setting(gravity, masses)
        return tuple(of.kind.build(self.mechanism, of.joints, of.kind.again(setting, of.inputs)) for of in self.found)

    def joint_values(
        self, readings: ArrayLike, torques: ArrayLike | None = None, previous: ArrayLike | None = None
    ) -> tuple[Floats, Floats]:
        """Compute the joints' true values and their derivatives by the readings.

        Args:
            readings: (N, k) of the actuated joints. [rad or m]
            torques: (N, k) measured, of the same joints. [N m or N]
            previous: (N, k) readings where the arm came from. [rad or m]

        Returns:
            (N, n) values of all joints, flexures included, and (N, n, k).

        Raises:
            SessionError: the compliance is that under measured torques, and there are none.
        """
        chain = self.mechanism
        q, J = chain.joint_values(readings), chain.reading_jacobian
        came = None if previous is None else chain.joint_values(previous)
        tau = None if torques is None else chain.torques(np.asarray(torques, dtype=float))
        each = np.arange(len(q))
        given = Readings(q, each, AT_REST, np.zeros_like(each), tau, came)
        true, slope = q, np.broadcast_to(np.eye(q.shape[1]), (*q.shape, q.shape[1]))
        for model, of in zip(self.models, self.found, strict=True):
            true = true + model.values(given, of.values)
            slope = slope + model.derivative(given, of.values)
        return true, slope @ J

    @cached_property
    def _of_one(self) -> tuple[OneCommand, ...]:
        return tuple(model.of_one(of.values) for model, of in zip(self.models, self.found, strict=True))

    @cached_property
    def _told(self) -> AsTold:
        return AsTold(self.mechanism)

    def of_one(self, torques: Floats | None = None, previous: Floats | None = None) -> TrueValuesOfCommand:
        """Return what the joints do when one command is given.

        Args:
            torques: (k,) measured. [N m or N]
            previous: (k,) readings where the arm came from. [rad or m]
        """
        chain = self.mechanism
        return TrueValuesOfCommand(
            self._of_one,
            self._told,
            None if torques is None else chain.torques(torques[None]),
            None if previous is None else chain.joint_values(previous[None]),
        )


@lru_cache(maxsize=8)  # a controller asks for one command after the other
def _carrying(models: FoundJointModels, carried: Payload | Literal["nothing"]) -> FoundJointModels:
    changed = replace(models, payload=None if carried == "nothing" else carried)
    _ = changed.models
    return changed


@dataclass(frozen=True, eq=False)
class TrueValuesOfCommand:
    """What joints do that are told to be somewhere: one command at a time, without what is made for many.

    Attributes:
        models: with their parameters.
        told: where rigid joints would be.
        torques: (1, n) measured, None where there are none. [N m or N]
        previous: (1, n) where the joints came from, None where that is not known. [rad or m]
    """

    models: tuple[OneCommand, ...]
    told: AsTold
    torques: Floats | None
    previous: Floats | None

    def values(self, q: Floats) -> Floats:
        """Compute for a command (k,) the true values (n,) of all joints. [rad or m]."""
        told = self.told.values(q)
        readings, result = self._readings(told), told
        for model in self.models:
            result = result + model.values(readings)
        return result

    def slopes(self, q: Floats) -> Floats:
        """Compute the derivative (n, k) of :meth:`values`."""
        readings, result = self._readings(self.told.values(q)), np.eye(len(self.told.mechanism.joints))
        for model in self.models:
            result = result + model.slopes(readings)
        slopes: Floats = result @ self.told.slopes(q)
        return slopes

    def _readings(self, told: Floats) -> Readings:
        return Readings(told[None], _FIRST, AT_REST, _FIRST, self.torques, self.previous)
