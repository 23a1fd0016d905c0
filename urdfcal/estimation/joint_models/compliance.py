"""Compliance: joints yield to their torque, by gears and bearings that are no stiffer than they are."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.estimation.joint_models.linear import LinearJointModel, Prior
from urdfcal.robot.gravity import Masses, masses_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.estimation.joint_models.linear import OneCommand, Setting
    from urdfcal.robot.mechanism import Joint
    from urdfcal.session.model import Positions


@dataclass(frozen=True, eq=False)
class Compliance(LinearJointModel):
    """Each joint gives way by its compliance times its torque: as measured, or what holds the arm against gravity.

    Measured torques have the sign that the maker gives them; compliances then have it, too.

    Strain-wave and cycloidal gears of arms of 5 to 30 kg yield by 1e-5 to 7e-5 rad/(N m): catalogues give 1e4 to 1e5
    N m/rad at the output (Harmonic Drive CSG-20 to 40: 1.3e4 to 1.2e5; Nabtesco RV-20E: 1.7e5); a UR10 before a laser
    tracker has 1.7e-5, an arm of seven axes with measured torques 6.5e-5. Ball screws: 1e7 to 1e9 N/m; belts 1e6.

    Attributes:
        masses: that the joints carry in each part of the session; none where torques are measured.
        gravity: (3,) in the base link's frame. [m/s^2]
    """

    name: ClassVar[str] = "compliance"
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"torque": (0,)}
    over: ClassVar[tuple[str, str, str] | None] = ("torque on it", "N m", "N")
    revolute: ClassVar[Prior | None] = Prior("rad/(N m)", 5e-5, 0.05)
    prismatic: ClassVar[Prior | None] = Prior("m/N", 1e-6, 0.01)
    together: ClassVar[bool] = True
    certain: ClassVar[float] = 0.0

    masses: tuple[Masses, ...] = field(kw_only=True)
    gravity: Floats = field(kw_only=True)

    @classmethod
    def depends_on(cls, session: Positions) -> dict[str, Any] | None:
        """Take measured torques, else the masses of URDF and payload."""
        if session.torques is not None:
            return {"masses": (), "gravity": session.gravity}
        payloads = session.payloads or (session.payload,) * len(session.parts)
        urdf, chain = session.urdf, session.chain
        masses = () if urdf is None else tuple(masses_of(urdf, chain, payload) for payload in payloads)
        return {"masses": masses, "gravity": session.gravity} if masses and None not in masses else None

    @classmethod
    def again(cls, setting: Setting, inputs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Take the masses."""
        return {"masses": setting.masses, "gravity": setting.gravity}

    def features(self, readings: Readings) -> Floats:
        """Return the torques, against which a joint gives way.

        Raises:
            SessionError: they were measured where the compliance was found, and are not known here.
        """
        tau = readings.torques
        if self.masses:
            tau = np.empty_like(readings.q)
            for part, here in self._parts(readings):
                tau[here] = self.masses[part].torques(readings.q[here], self.gravity)
        if tau is None:
            raise SessionError(
                "the compliance is that under measured torques, and these readings have none",
                where="torques",
                remedy="Give the torques of every pose (`urdfcal compensate --torques FILE.csv`).",
            )
        carried: Floats = -(tau @ self.mechanism.reading_jacobian)[:, self.joints]
        return carried

    def slopes(self, readings: Readings) -> Floats:
        """Return those of the torques; measured ones do not follow the readings."""
        found = np.zeros((*readings.q.shape, readings.q.shape[1]))
        for part, here in self._parts(readings):
            found[here] = self.masses[part].slopes(readings.q[here], self.gravity)
        result: Floats = -(self.mechanism.reading_jacobian.T @ found)[:, self.joints]
        return result

    def _parts(self, readings: Readings) -> Iterator[tuple[int, Bools | slice]]:
        """The parts of the session that the arm carried something in, and which readings are of them."""
        if len(self.masses) == 1:
            yield 0, slice(None)
            return
        for part in np.unique(readings.part) if self.masses else ():
            yield part, readings.part == part

    def of_one(self, p: Floats) -> OneCommand:
        """Take the torques straight from Pinocchio where gravity gives them."""
        if len(self.masses) != 1:
            return super().of_one(p)
        yields = -(self._carry * p) @ self.mechanism.reading_jacobian.T[list(self.joints)]
        return _Yielding(self.masses[0], self.gravity, yields)

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say how much it yields."""
        unit = "m/N" if joint.prismatic else "rad/(N m)"
        return f"{joint.name} yields under the arm's weight, {abs(p[0]):.1e} {unit}: the arm bends"

    def sentence_of_all(self, joints: str, most: float) -> str:
        """Say how much they yield."""
        return f"sag of {joints} under the arm's weight, by up to {most:.2g} mrad: the arm bends"


@dataclass(frozen=True, eq=False)
class _Yielding:
    """What joints yield by in one pose: their torques times ``yields`` (n, n)."""

    masses: Masses
    gravity: Floats
    yields: Floats

    def values(self, readings: Readings) -> Floats:
        result: Floats = self.yields @ self.masses.torques(readings.q, self.gravity)[0]
        return result

    def slopes(self, readings: Readings) -> Floats:
        result: Floats = self.yields @ self.masses.slopes(readings.q, self.gravity)[0]
        return result
