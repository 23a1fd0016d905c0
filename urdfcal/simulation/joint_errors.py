"""Errors of simulated joints: where a joint truly is when its encoder says something else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.estimation.joint_models import Readings
from urdfcal.estimation.joint_models.backlash import Backlash
from urdfcal.estimation.joint_models.bending import Bending
from urdfcal.estimation.joint_models.compliance import Compliance
from urdfcal.estimation.joint_models.gain import Gain
from urdfcal.estimation.joint_models.gravity_backlash import GravityBacklash
from urdfcal.estimation.joint_models.harmonics import Harmonics
from urdfcal.estimation.joint_models.lag import Lag
from urdfcal.estimation.joint_models.under_torque import UnderTorque
from urdfcal.robot.kinematics import tip_poses
from urdfcal.session.bending import bent
from urdfcal.session.knowledge import JointError
from urdfcal.session.model import Positions

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.linear import LinearJointModel
    from urdfcal.session.knowledge import ErrorSizes
    from urdfcal.simulation.truth import Simulated

# Keeps the joints' random numbers apart from all others.
_STREAM = 6
# Encoders and gears err less twice a turn than once.
_TWICE = 0.3
# A link is not as stiff about one axis as about the other: it is no tube, or carries a motor on one side.
_ASIDE = (0.25, 1.0)


@dataclass(frozen=True)
class _Kind:
    """A kind of error, as the joint model that corrects it has it.

    Attributes:
        model: whose parameters are drawn.
        usual: least and largest size of a turning joint. [rad/(N m), rad or 1]
        sliding: factor on it of a sliding joint. [m/rad, or 1]
        factor: from the size to the model's parameter, of a model that has one a joint.
        either: whether it has either sign.
    """

    model: type[LinearJointModel]
    usual: tuple[float, float]
    sliding: float = 1.0
    factor: float = 1.0
    either: bool = False

    def parameters(self, size: Floats, rng: np.random.Generator) -> Floats:
        """Return the model's parameters (k, words) of joints with such errors (k,)."""
        if self.model is Bending:
            return size[:, None] * rng.uniform(*_ASIDE, (len(size), len(Bending.words)))
        if self.model is not Harmonics:
            return self.factor * size[:, None]
        phase = rng.uniform(0.0, 2.0 * np.pi, (len(size), 2))
        amplitude = size[:, None] * [1.0, _TWICE]
        waves = amplitude[..., None] * np.stack([np.cos(phase), np.sin(phase)], axis=2)
        result: Floats = waves.reshape(len(size), -1)
        return result


_KINDS: dict[JointError, _Kind] = {
    # Catalogues of gears, and arms that were measured: see the class. Screws and belts: 2e-7 to 1.4e-6 m/N.
    "compliance": _Kind(Compliance, (1e-5, 7e-5), sliding=0.02),
    # A graduation of diameter D that runs off centre by e errs by 2 e / D (HEIDENHAIN, Rotary Encoders: 412 e/D with e
    # in um, D in mm, seconds of arc): 2 to 20 um, mounted well and badly, on 40 mm.
    "eccentricity": _Kind(Harmonics, (1e-4, 1e-3)),
    # Between both sides: 0.3 to 3 minutes of arc, from good gears of industrial arms to bad ones. Screws: 10 to 100 um.
    "backlash": _Kind(Backlash, (1e-4, 1e-3), sliding=0.1, factor=-0.5),
    # Of the way that the joint came: the repeatability of industrial arms (ISO 9283), and several times that.
    "lag": _Kind(Lag, (1e-4, 5e-4), factor=-1.0),
    # Ball screws of ISO 3408 classes 7 to 10.
    "gain": _Kind(Gain, (2e-4, 7e-4), either=True),
    # As backlash, of gears that the arm's weight turns back.
    "gravity_backlash": _Kind(GravityBacklash, (1e-4, 1e-3), sliding=0.1, factor=0.5),
    # Bearings and tubes: see the class.
    "bending": _Kind(Bending, (2e-6, 2e-5)),  # in rad/(N m) before sliding joints, too
}


def draw_joint_errors(errors: ErrorSizes, positions: Positions, seed: int) -> dict[str, Floats]:
    """Draw what is wrong with the joints of a simulated robot.

    Args:
        errors: the size of each kind of error: compliance [rad/(N m) or m/N], amplitude of the eccentricity [rad],
            backlash from side to side [rad or m], lag as a share of the way that the joint came, gain as a share of its
            reading; of all joints, of each by name (others have none), or ``default`` for realistic ones.
        positions: the robot, and what it carries.
        seed: of what is random; a kind of error and a joint do not change what is drawn for others.

    Returns:
        By the name of the joint model its parameters (k,).

    Raises:
        SessionError: a joint has no such error, or the URDF has no masses under which the arm could bend.
    """
    drawn: dict[str, Floats] = {}
    for name, said in errors.items():
        kind = _KINDS[name]
        rng = np.random.default_rng((seed, _STREAM, get_args(JointError).index(name)))
        model = _applied(kind.model, _bending(positions, errors))
        joints = list(dict.fromkeys(model.names_of_joints))
        prismatic = np.array([joint.prismatic for joint in model.mechanism.actuated_joints if joint.name in joints])
        usual = rng.uniform(*kind.usual, len(joints)) * np.where(prismatic, kind.sliding, 1.0)
        usual *= 1.0 - 2.0 * rng.integers(0, 2, len(joints)) * kind.either
        if not isinstance(said, str):
            sizes = said if not isinstance(said, float | int) else dict.fromkeys(joints, said)
            for joint in sizes:
                if joint not in joints:
                    remedy = "Leave it out: only turning joints have it."
                    raise SessionError(f"joint {joint!r} slides", where=f"errors.{name}", remedy=remedy)
            usual = np.array([float(sizes.get(joint, 0.0)) for joint in joints])
        drawn[kind.model.name] = kind.parameters(usual, rng).ravel()
    return drawn


def true_joint_values(positions: Positions, errors: Mapping[str, Floats]) -> Floats:
    """Compute where joints truly are.

    Args:
        positions: with what perfect encoders say.
        errors: parameters (k,) of joint models, by name, as they were drawn.

    Returns:
        (N, n) joint values, of flexures where links bend too. [rad or m]

    Raises:
        SessionError: an error is one of arms that stand still, and this one moves.
    """
    positions = _bending(positions, errors)
    readings, q = Readings.of(positions), positions.q
    for kind in (kind.model for kind in _KINDS.values() if kind.model.name in errors):
        q = q + _applied(kind, positions).values(readings, errors[kind.name])
    return q


def true_tips(simulated: Simulated, q: Floats) -> Floats:
    """Compute where the tip of a simulated robot truly is, T_base_tip (N, 4, 4), at readings ``q`` (N, n). [m]."""
    truth, setup = simulated.truth, simulated.session.of_setup()
    # Where the arm comes from is anyone's choice: it has settled, as a calibration takes it that is not told.
    there = Positions(**setup, poses=tuple(map(str, range(len(q)))), q=q, previous=q)
    return tip_poses(truth.chain, true_joint_values(there, truth.joint_errors), truth.placements)


def joint_errors_to_dicts(positions: Positions, errors: Mapping[str, Floats]) -> list[dict[str, Any]]:
    """List the parameters of joint models for truth.json, called as the calibration's are."""
    positions = _bending(positions, errors)
    models = [_applied(kind.model, positions) for kind in _KINDS.values() if kind.model.name in errors]
    return [
        {"parameter": name, "unit": unit, "value": value + 0.0}  # no "-0.0"
        for model in models
        for name, unit, value in zip(model.names, model.units, errors[model.name].tolist(), strict=True)
    ]


def _bending(positions: Positions, errors: Collection[str]) -> Positions:
    """The same, with flexures where some of the errors are that links bend."""
    return bent(positions, positions.chain.actuated) if Bending.name in errors else positions


def _applied(kind: type[LinearJointModel], positions: Positions) -> LinearJointModel:
    """The joint model of a robot in some positions."""
    model = kind.of(positions)
    if model is None:
        (name,) = (name for name, of in _KINDS.items() if of.model is kind)
        what, remedy = "it is an error of arms that stand still", "Leave it out, or simulate poses, not a trajectory."
        if issubclass(kind, UnderTorque):
            what, remedy = (
                "the URDF has no masses that would load its joints",
                "Leave it out, or give the links <inertial>.",
            )
        elif kind is Harmonics:
            what, remedy = "no joint turns", "Leave it out."
        raise SessionError(what, where=f"errors.{name}", remedy=remedy)
    return model
