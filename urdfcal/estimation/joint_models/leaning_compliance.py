"""Compliance of an arm whose base leans, nobody knows where to: how its joints yield tells where gravity points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.estimation.joint_models.compliance import Compliance
from urdfcal.estimation.joint_models.under_torque import UnderTorque

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.estimation.joint_models.linear import Prior
    from urdfcal.robot.mechanism import Joint
    from urdfcal.session.model import Positions

# Least squares on products, one factor after the other: from the principal direction they are there after a few.
_ROUNDS = 20
# Standard deviations beyond which joints yield one way rather than the other.
_SURE = 3.0


@dataclass(frozen=True, eq=False)
class LeaningCompliance(UnderTorque):
    """Each joint gives way by the torques that gravity along x, y and z of the base link's frame would give it.

    A torque at rest is linear in the gravity vector, so that compliance and direction are, joint by joint, three
    parameters: the compliance times gravity's direction (3,). That joints agree in it is not used: the estimate stays
    linear, and true to its intervals, however the arm is mounted.
    """

    name: ClassVar[str] = "leaning_compliance"
    needs: ClassVar[str] = "masses in the URDF, no measured torques, and gravity: {direction: free}"
    words: ClassVar[tuple[str, ...]] = ("x", "y", "z")
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"torque": (0, 1, 2)}
    revolute: ClassVar[Prior | None] = Compliance.revolute  # in any direction
    prismatic: ClassVar[Prior | None] = Compliance.prismatic
    together: ClassVar[bool] = Compliance.together
    certain: ClassVar[float] = Compliance.certain
    sentence_of_all = Compliance.sentence_of_all

    @classmethod
    def depends_on(cls, session: Positions) -> dict[str, Any] | None:
        """Apply where the session does not say where gravity points."""
        return None if session.estimate.gravity is None or session.torques is not None else cls.weights(session)

    def features(self, readings: Readings) -> Floats:
        """Return the torques under gravity along each axis, against which a joint gives way."""
        found = np.empty((len(readings.q), len(self)))
        for axis, mine in self._axes():
            found[:, mine] = self.carried(readings, axis)[:, mine]
        return found

    def slopes(self, readings: Readings) -> Floats:
        """Return those of the torques."""
        found = np.empty((len(readings.q), len(self), readings.q.shape[1]))
        for axis, mine in self._axes():
            found[:, mine] = self.carried_slopes(readings, axis)[:, mine]
        return found

    def _axes(self) -> Iterator[tuple[Floats, slice]]:
        """Gravity along each axis, and the parameters that are of it."""
        for k, axis in enumerate(np.linalg.norm(self.gravity) * np.eye(3)):
            yield axis, slice(k, None, len(self.words))

    @staticmethod
    def direction(p: Floats, sigma: Floats) -> tuple[Floats, float]:
        """Estimate the direction that the joints agree in: weighted least squares on compliances times directions.

        Args:
            p: (k,) parameters.
            sigma: (k,) their standard deviations; of what is not estimated not finite.

        Returns:
            The direction (3,) of gravity, and its standard deviation. [rad]
        """
        values, weight = p.reshape(-1, 3), np.where(np.isfinite(sigma), sigma, np.inf).reshape(-1, 3) ** -2.0
        _, _, Vt = np.linalg.svd(np.sqrt(weight) * values)
        direction = Vt[0]
        for _ in range(_ROUNDS):
            compliance = (weight * values) @ direction / np.maximum(weight @ direction**2, 1e-300)
            direction = compliance @ (weight * values) / np.maximum(compliance**2 @ weight, 1e-300)
            direction /= np.linalg.norm(direction)
        # Joints yield to gravity, not against it; those that hardly tell do not count.
        scores = compliance * np.sqrt(weight @ direction**2)
        if np.sum(scores) < 0.0:
            direction = -direction
        information = np.maximum(compliance**2 @ weight, 1e-300)
        # The part along the direction is the compliance's.
        across = np.eye(3) - np.outer(direction, direction)
        sigma_direction = float(np.sqrt(np.trace(across @ np.diag(1.0 / information) @ across)))
        sure = abs(np.sum(scores)) > _SURE * np.sqrt(np.count_nonzero(scores))
        return direction, sigma_direction if sure else np.pi

    def summary(self, readings: Readings, p: Floats, sigma: Floats) -> str:
        """Say where gravity comes out to point."""
        (x, y, z), uncertain = self.direction(p, sigma)
        lean = np.degrees(np.arccos(np.clip(-z, -1.0, 1.0)))
        return (
            f"{super().summary(readings, p, sigma)}; gravity points along [{x:.2f}, {y:.2f}, {z:.2f}] of the base "
            f"link's frame, {lean:.1f} ± {np.degrees(uncertain):.1g} deg from its -z"
        )

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say how much it yields."""
        del group
        unit = "m/N" if joint.prismatic else "rad/(N m)"
        return f"{joint.name} yields under the arm's weight, {np.linalg.norm(p):.1e} {unit}: the arm bends"
