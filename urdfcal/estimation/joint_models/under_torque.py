"""Joint models whose features follow from joint torques: as they were measured, or under the arm's weight."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.robot.gravity import Masses, masses_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.estimation.joint_models.linear import Setting
    from urdfcal.session.model import Positions


@dataclass(frozen=True, eq=False)
class UnderTorque(LinearJointModel):
    """What joints do under their torques.

    Attributes:
        masses: that the joints carry in each part of the session; none where torques are measured.
        gravity: (3,) in the base link's frame. [m/s^2]
    """

    needs: ClassVar[str] = "masses in the URDF, or measured torques"

    masses: tuple[Masses, ...] = field(kw_only=True)
    gravity: Floats = field(kw_only=True)

    @classmethod
    def depends_on(cls, session: Positions) -> dict[str, Any] | None:
        """Take measured torques, else the masses of URDF and payload under gravity, where its direction is known."""
        if session.torques is not None:
            return {"masses": (), "gravity": session.gravity}
        return cls.weights(session) if session.estimate.gravity is None else None

    @staticmethod
    def weights(session: Positions) -> dict[str, Any] | None:
        """Return the masses of URDF and payload, and gravity; None where there are none."""
        payloads = session.payloads or (session.payload,) * len(session.parts)
        urdf, chain = session.urdf, session.chain
        masses = () if urdf is None else tuple(masses_of(urdf, chain, payload) for payload in payloads)
        return {"masses": masses, "gravity": session.gravity} if masses and None not in masses else None

    @classmethod
    def again(cls, setting: Setting, inputs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Take the masses."""
        del inputs
        return {"masses": setting.masses, "gravity": setting.gravity}

    def torques(self, readings: Readings, gravity: Floats) -> Floats:
        """Return the torques (N, n) that all joints carry, with the sign of those that were measured. [N m or N].

        Args:
            readings: N of them.
            gravity: (3,) in the base link's frame, for torques that were not measured. [m/s^2]

        Raises:
            SessionError: they were measured where the model was found, and are not known here.
        """
        tau = readings.torques
        if self.masses:
            tau = np.empty_like(readings.q)
            for part, here in self.parts(readings):
                tau[here] = self.masses[part].torques(readings.q[here], gravity)
        if tau is None:
            raise SessionError(
                f"the {self.name.replace('_', ' ')} is that under measured torques, and these readings have none",
                where="torques",
                remedy="Give the torques of every pose (`urdfcal compensate --torques FILE.csv`).",
            )
        return tau

    def carried(self, readings: Readings, gravity: Floats | None = None) -> Floats:
        """Return the torques (N, k), against which joints give way, of the parameters' joints."""
        tau = self.torques(readings, self.gravity if gravity is None else gravity)
        carried: Floats = -(tau @ self.mechanism.reading_jacobian)[:, self.joints]
        return carried

    def carried_slopes(self, readings: Readings, gravity: Floats | None = None) -> Floats:
        """Return the derivative (N, k, n) of :meth:`carried`; measured torques do not follow the readings."""
        found = np.zeros((*readings.q.shape, readings.q.shape[1]))
        for part, here in self.parts(readings):
            found[here] = self.masses[part].slopes(readings.q[here], self.gravity if gravity is None else gravity)
        slopes: Floats = -(self.mechanism.reading_jacobian.T @ found)[:, self.joints]
        return slopes

    def parts(self, readings: Readings) -> Iterator[tuple[int, Bools | slice]]:
        """Yield the parts of the session that the arm carried something in, and which readings are of them."""
        if len(self.masses) == 1:
            yield 0, slice(None)
            return
        for part in np.unique(readings.part) if self.masses else ():
            yield part, readings.part == part


@dataclass(frozen=True, eq=False)
class Yielding:
    """Joints that yield to the weight they carry, for one pose at a time.

    Attributes:
        masses: that they carry.
        gravity: (3,) in the base link's frame. [m/s^2]
        yields: (n, n) by how much each yields to each one's torque. [rad/(N m) and the like]
    """

    masses: Masses
    gravity: Floats
    yields: Floats

    def values(self, readings: Readings) -> Floats:
        """Return what joints (n,) yield by in one pose. [rad or m]."""
        result: Floats = self.yields @ self.masses.torques(readings.q, self.gravity)[0]
        return result

    def slopes(self, readings: Readings) -> Floats:
        """Return the derivative (n, n) of :meth:`values`."""
        result: Floats = self.yields @ self.masses.slopes(readings.q, self.gravity)[0]
        return result
