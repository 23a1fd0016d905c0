"""Compliance: joints yield to their torque, by gears and bearings that are no stiffer than they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from urdfcal.estimation.joint_models.linear import Prior
from urdfcal.estimation.joint_models.under_torque import UnderTorque, Yielding

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.estimation.joint_models.linear import OneCommand
    from urdfcal.robot.mechanism import Joint


@dataclass(frozen=True, eq=False)
class Compliance(UnderTorque):
    """Each joint gives way by its compliance times its torque: as measured, or what holds the arm against gravity.

    Measured torques have the sign that the maker gives them; compliances then have it, too.

    Strain-wave and cycloidal gears of arms of 5 to 30 kg yield by 1e-5 to 7e-5 rad/(N m): catalogues give 1e4 to 1e5
    N m/rad at the output (Harmonic Drive CSG-20 to 40: 1.3e4 to 1.2e5; Nabtesco RV-20E: 1.7e5); a UR10 before a laser
    tracker has 1.7e-5, an arm of seven axes with measured torques 6.5e-5. Ball screws: 1e7 to 1e9 N/m; belts 1e6.
    """

    name: ClassVar[str] = "compliance"
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"torque": (0,)}
    over: ClassVar[tuple[str, str, str] | None] = ("torque on it", "N m", "N")
    revolute: ClassVar[Prior | None] = Prior("rad/(N m)", 5e-5, 0.05)
    prismatic: ClassVar[Prior | None] = Prior("m/N", 1e-6, 0.01)
    together: ClassVar[bool] = True
    certain: ClassVar[float] = 0.0

    def features(self, readings: Readings) -> Floats:
        """Return the torques, against which a joint gives way."""
        return self.carried(readings)

    def slopes(self, readings: Readings) -> Floats:
        """Return those of the torques."""
        return self.carried_slopes(readings)

    def of_one(self, p: Floats) -> OneCommand:
        """Take the torques straight from Pinocchio where gravity gives them."""
        if len(self.masses) != 1:
            return super().of_one(p)
        yields = -(self._carry * p) @ self.mechanism.reading_jacobian.T[list(self.joints)]
        return Yielding(self.masses[0], self.gravity, yields)

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say how much it yields."""
        unit = "m/N" if joint.prismatic else "rad/(N m)"
        return f"{joint.name} yields under the arm's weight, {abs(p[0]):.1e} {unit}: the arm bends"

    def sentence_of_all(self, joints: str, most: float) -> str:
        """Say how much they yield."""
        return f"sag of {joints} under the arm's weight, by up to {most:.2g} mrad: the arm bends"
