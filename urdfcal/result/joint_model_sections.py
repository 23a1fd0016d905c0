"""The parts of the result document that hold joint models, and what they need to be evaluated at new readings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from urdfcal.arrays import frozen
from urdfcal.estimation.joint_models import JOINT_MODELS
from urdfcal.estimation.joint_models.bending import Bending
from urdfcal.estimation.joint_models.found import FoundJointModels, FoundModel
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.joint_models.under_torque import UnderTorque
from urdfcal.result.evidence_sections import Section, Sigmas, Transform, Triple
from urdfcal.robot.flexure import with_flexures
from urdfcal.robot.gravity import STANDARD_GRAVITY, Masses, masses_of, place_of
from urdfcal.robot.mechanism import BASE, Tip
from urdfcal.session.knowledge import Payload

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.result.document import ResultDocument
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.robot.mechanism import Mechanism

_KINDS = {kind.name: kind for kind in JOINT_MODELS if issubclass(kind, LinearJointModel)}


class JointModelEntry(Section):
    """A joint model of a joint: its parameters (SI units), and what left-out poses are nearer with it. [mm].

    ``inputs`` is what the model needs beside: a gear ratio, or a mixture of torques.
    """

    values: list[float]
    sigma: Sigmas
    gain_mm: float | None
    inputs: dict[str, float | list[list[float]]] = Field(default_factory=dict)


class MassEntry(Section):
    """The mass of a joint's links, and its centre in the joint's frame. [kg, m]."""

    mass: float
    center: Triple


class PayloadEntry(MassEntry):
    """What the arm carried: its centre is in the frame of its link, which is in that of a joint, or of the base."""

    link: str
    joint: str | None
    T_joint_link: Transform


class LoadSection(Section):
    """Gravity in the base link's frame, and the masses of the arm alone where torques were not measured. [m/s^2]."""

    gravity: Triple
    masses: dict[str, MassEntry] = Field(default_factory=dict)
    payload: PayloadEntry | None = None


def check_joint_models(
    joint_models: Mapping[str, Mapping[str, JointModelEntry]], load: LoadSection | None, joints: Mapping[str, object]
) -> None:
    """Check that joint models are those of a robot's joints, and complete.

    Raises:
        ValueError: one is not.
    """
    for joint, model, entry in ((j, name, entry) for j, of in joint_models.items() for name, entry in of.items()):
        if joint not in joints or model not in _KINDS:
            raise ValueError(f"joint_models.{joint}.{model} is no joint model of a joint of the robot")
        if len(entry.values) != len(_KINDS[model].words):
            raise ValueError(f"joint_models.{joint}.{model} has {len(entry.values)} values")
    if joint_models and load is None:
        raise ValueError("there are joint_models, but no load")
    if load is not None and load.masses and {*load.masses} != {*joints}:
        raise ValueError("load.masses are not those of the robot's joints")
    if load is not None and load.payload is not None and load.payload.joint not in (None, *joints):
        raise ValueError(f"the payload's joint is {load.payload.joint!r}, which the robot has not")


def joint_model_sections(of: FittedCalibration) -> dict[str, Any]:
    """Collect the joint models of an estimate, by joint and model; without any there is no ``load``."""
    gains = {(t.term.model, joint): g for t in of.comparison.chosen.joint_models for joint, g in t.by_joint.items()}
    entries: dict[str, dict[str, JointModelEntry]] = {}
    load: dict[str, Any] = {}
    blocks = [block for block in of.fit.parameters.blocks if isinstance(block, LinearJointModel)]
    for block in blocks:
        values, sigmas = of.fit.state[block.key], of.sigmas_of(block.key)
        for joint in dict.fromkeys(np.array(block.names_of_joints)[block.active].tolist()):
            mine = block.of_joints([joint])
            gain = gains.get((block.name, joint))
            inputs = block.inputs(mine)
            entries.setdefault(joint, {})[block.name] = JointModelEntry(
                values=values[mine].tolist(),
                sigma=[float(s) if np.isfinite(s) else None for s in sigmas[mine]],
                gain_mm=None if gain is None else 1e3 * gain,
                **({"inputs": inputs} if inputs else {}),
            )
        if isinstance(block, UnderTorque) and block.masses:
            load["masses"] = _masses(of)
    if entries:
        load = {"load": LoadSection(gravity=of.session.gravity.tolist(), **{**load, **_payload(of)})}
    return {"joint_models": {joint: entries[joint] for joint in of.chain.actuated if joint in entries}, **load}


def _masses(of: FittedCalibration) -> dict[str, MassEntry]:
    found = None if of.session.urdf is None else masses_of(of.session.urdf, of.chain)
    n = len(of.chain.names)
    found = found or Masses(of.chain, np.zeros(n), np.zeros((n, 3)))  # the payload is all that is heavy
    each = zip(of.chain.names, found.mass.tolist(), found.center.tolist(), strict=True)
    return {joint: MassEntry(mass=mass, center=center) for joint, mass, center in each}


def _payload(of: FittedCalibration) -> dict[str, PayloadEntry]:
    """What was carried; of several sessions, in the first."""
    payload, urdf = (of.session.payloads or (of.session.payload,))[0], of.session.urdf
    if payload is None or urdf is None:
        return {}
    at = place_of(urdf, of.chain, payload.link)
    entry = PayloadEntry(
        link=payload.link,
        mass=payload.mass,
        center=payload.center.tolist(),
        joint=None if at.joint == BASE else of.chain.names[at.joint],
        T_joint_link=at.T_joint_link.tolist(),
    )
    return {"payload": entry}


def found_joint_models(document: ResultDocument, chain: Mechanism) -> FoundJointModels:
    """Read the joint models of a result, of its nominal joints."""
    found, load = [], document.load
    for name, kind in _KINDS.items():
        entries = {joint: of[name] for joint, of in document.joint_models.items() if name in of}
        if entries:
            joints = tuple(joint for joint in chain.actuated if joint in entries)
            values = np.array([value for joint in joints for value in entries[joint].values])
            found.append(FoundModel(kind, joints, values, tuple(entries[joint].inputs for joint in joints)))
    bending = next((of.joints for of in found if of.kind is Bending), ())
    mechanism = with_flexures(chain, bending) if bending else chain
    if load is None:
        return FoundJointModels(mechanism, tuple(found), STANDARD_GRAVITY)
    masses = [load.masses[name] for name in chain.names if load.masses]
    payload = (
        None if load.payload is None else Payload(load.payload.link, load.payload.mass, frozen(load.payload.center))
    )
    places: tuple[Tip, ...] = ()
    if load.payload is not None:
        joint = BASE if load.payload.joint is None else mechanism.names.index(load.payload.joint)
        places = (Tip(load.payload.link, joint, np.array(load.payload.T_joint_link)),)
    carried = (
        Masses(chain, np.array([m.mass for m in masses]), np.array([m.center for m in masses])) if masses else None
    )
    return FoundJointModels(
        mechanism,
        tuple(found),
        np.array(load.gravity),
        None if carried is None else carried.on(mechanism),
        payload,
        places,
    )
