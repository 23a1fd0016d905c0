"""Compliance of an arm whose masses nobody knows: joints yield to whatever torques gravity can give."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.estimation.joint_models.compliance import Compliance
from urdfcal.estimation.joint_models.linear import LinearJointModel, Prior
from urdfcal.estimation.joint_models.under_torque import UnderTorque
from urdfcal.robot.gravity import Masses, torque_regressor

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.estimation.joint_models.linear import Setting
    from urdfcal.robot.mechanism import Joint
    from urdfcal.session.model import Positions

# Of a link of unknown inertia, one standard deviation: its mass [kg], and that times its centre's distance [kg m].
_MASS, _MOMENT = 5.0, 0.75
# Configurations that tell which torques gravity can give, and the share of the largest below which there are none.
_CONFIGURATIONS, _LEAST = 200, 1e-2
_MOST = 8


@dataclass(frozen=True, eq=False)
class TorqueBasis(LinearJointModel):
    """Each joint gives way to a mixture of the torques that any masses of the links would give it under gravity.

    The torques at rest are linear in masses and first moments (``pin.computeJointTorqueRegressor``); for each joint the
    principal ones, with links of 5 kg and compliances of 5e-5 rad/(N m), have unit priors. It says little of regions
    that were not measured: a UR10 is 1.5 mm off in another one, with the masses of its URDF 0.67.

    Attributes:
        gravity: (3,) in the base link's frame. [m/s^2]
        mixture: (4 n, k) of the columns of a joint's torque regressor for each parameter. [rad/(N m) times kg or kg m]
    """

    name: ClassVar[str] = "torque_basis"
    needs: ClassVar[str] = "a URDF without masses, and no measured torques"
    words: ClassVar[tuple[str, ...]] = tuple(map(str, range(1, _MOST + 1)))
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"torque": tuple(range(_MOST))}
    revolute: ClassVar[Prior | None] = Prior("1", 1.0, 1e3)

    gravity: Floats = field(kw_only=True)
    mixture: Floats = field(kw_only=True)

    @classmethod
    def depends_on(cls, session: Positions) -> dict[str, Any] | None:
        """Apply where neither torques nor masses are known."""
        weighed = session.torques is not None or UnderTorque.weights(session) is not None
        if weighed or Compliance.revolute is None:
            return None
        chain = session.chain
        q = chain.random_values(_CONFIGURATIONS, np.random.default_rng(0))
        usual = Compliance.revolute.sigma * np.tile([_MASS, *(_MOMENT,) * 3], len(chain.joints))
        mixtures = []
        regressor = torque_regressor(chain, q, session.gravity) * usual
        for j, joint in enumerate(chain.actuated_joints):
            if joint.prismatic:
                continue
            _, s, Vt = np.linalg.svd(regressor[:, j], full_matrices=False)
            parts = np.zeros((len(usual), _MOST))
            count = min(_MOST, int(np.sum(s > _LEAST * max(s[0], 1e-300))) if s[0] > 0.0 else 0)
            parts[:, :count] = usual[:, None] * Vt[:count].T
            mixtures.append(parts)
        return {"gravity": session.gravity, "mixture": np.hstack(mixtures) if mixtures else np.zeros((len(usual), 0))}

    @classmethod
    def again(cls, setting: Setting, inputs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Take gravity, and the mixtures that were kept: on another machine they may come out with other signs."""
        return {"gravity": setting.gravity, "mixture": np.hstack([of["mixture"] for of in inputs])}

    def inputs(self, columns: Bools) -> dict[str, Any]:
        """Keep the mixtures."""
        return {"mixture": self.mixture[:, columns].tolist()}

    def features(self, readings: Readings) -> Floats:
        """Return the principal torques, against which a joint gives way."""
        regressor = torque_regressor(self.mechanism, readings.q, self.gravity)[:, self.joints]
        torques: Floats = np.einsum("nkp,pk->nk", regressor, self.mixture)
        return -torques

    def slopes(self, readings: Readings) -> Floats:
        """Return those of the principal torques."""
        found = np.zeros((len(readings.q), len(self), len(self.mechanism.joints)))
        for k, (joint, column) in enumerate(zip(self.joints, self.mixture.T, strict=True)):
            mass, moment = np.split(column.reshape(-1, 4), [1], axis=1)
            # Torques are linear in masses and moments: what is negative is a difference of bodies with positive masses,
            # since Pinocchio cannot add up others.
            heavy = np.full(len(mass), 1.0 + np.abs(mass).max())
            bodies = (heavy, moment / heavy[:, None]), (heavy - mass[:, 0], np.zeros(moment.shape))
            more, less = (Masses(self.mechanism, *body).slopes(readings.q, self.gravity) for body in bodies)
            slopes = more - less
            found[:, k] = -self.mechanism.reading_jacobian[:, joint] @ slopes
        return found

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say that it yields."""
        del group, p
        return f"{joint.name} yields under the arm's weight, of which the URDF says nothing: the arm bends"

    def sentence_of_all(self, joints: str, most: float) -> str:
        """Say how much."""
        return (
            f"sag of {joints} under the arm's weight, by up to {most:.2g} mrad: the arm bends, by masses that the URDF "
            "does not have, and what is found of them says little of regions that were not measured"
        )
