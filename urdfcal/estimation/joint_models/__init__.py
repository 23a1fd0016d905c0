"""Joint models, one file for each: what lies between a joint reading and the joint's true value (METHOD 7)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from urdfcal.errors import SessionError
from urdfcal.estimation.joint_models.backlash import Backlash
from urdfcal.estimation.joint_models.base import JointModel, Readings, Term, forced_on
from urdfcal.estimation.joint_models.bending import Bending
from urdfcal.estimation.joint_models.compliance import Compliance
from urdfcal.estimation.joint_models.gain import Gain
from urdfcal.estimation.joint_models.gravity_backlash import GravityBacklash
from urdfcal.estimation.joint_models.harmonics import Harmonics
from urdfcal.estimation.joint_models.lag import Lag
from urdfcal.estimation.joint_models.leaning_compliance import LeaningCompliance
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.joint_models.motor_harmonics import MotorHarmonics
from urdfcal.estimation.joint_models.time_offset import TimeOffsets
from urdfcal.estimation.joint_models.torque_basis import TorqueBasis
from urdfcal.estimation.joint_models.zero_offset import ZeroOffsets
from urdfcal.session.bending import bent
from urdfcal.session.knowledge import AUTO

if TYPE_CHECKING:
    from urdfcal.session.model import Positions

JOINT_MODELS: tuple[type[JointModel], ...] = (
    ZeroOffsets,
    TimeOffsets,
    Compliance,
    LeaningCompliance,
    TorqueBasis,
    Lag,
    Gain,
    Harmonics,
    MotorHarmonics,
    Backlash,
    GravityBacklash,
    Bending,
)
"""Every joint model there is. A new one is a file of its own and a name here."""


def joint_models_of(session: Positions) -> tuple[JointModel, ...]:
    """Return the joint models that apply to a session, whether they are estimated or not.

    Raises:
        SessionError: one that the session switches on does not apply to it, or what it leaves free cannot be found.
    """
    session = bent(session)
    kind_of = {kind.name: kind for kind in JOINT_MODELS}
    models = {name: kind.of(session) for name, kind in kind_of.items()}
    for name, said in session.joint_models.items():
        if isinstance(said, Mapping) and not isinstance(models[name], LinearJointModel | None):
            raise SessionError(
                f"{name} is not a matter of single joints", where="joint_models", remedy="Write on or off."
            )
    for name, model in models.items():
        if model is None and forced_on(session.joint_models.get(name, AUTO)):
            raise SessionError(
                f"{name} is switched on, but what it depends on is not in this session: {kind_of[name].needs}",
                where="joint_models",
                remedy=f"Leave it out, or write {name}: off.",
            )
    if session.estimate.gravity is not None and models[LeaningCompliance.name] is None:
        raise SessionError(
            "where gravity points shows in how links of known mass bend, and "
            + ("torques were measured" if session.torques is not None else "the URDF has no masses"),
            where="gravity",
            remedy="Write it as [x, y, z] in the base link's frame, in m/s^2, or leave it out.",
        )
    return tuple(model for model in models.values() if model is not None)


__all__ = ["JOINT_MODELS", "JointModel", "Readings", "Term", "joint_models_of"]
