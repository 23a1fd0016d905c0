"""Harmonics: a joint errs with its own angle, once and twice a turn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.joint_models.linear import LinearJointModel, Prior

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.robot.mechanism import Joint

# [rad]
_TURN = 1.0


@dataclass(frozen=True, eq=False)
class Harmonics(LinearJointModel):
    """An encoder's eccentricity errs once a turn, its ellipticity and the gear's twice.

    An eccentricity of 2 um on a disc of 40 mm is 0.1 mrad. With wider priors harmonics that one region suggests spoil
    others: 1.3 to 4 mm on a UR10 that is 0.7 mm off without.
    """

    name: ClassVar[str] = "harmonics"
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"harmonic 1": (0, 1), "harmonic 2": (2, 3)}
    words: ClassVar[tuple[str, ...]] = ("sin1", "cos1", "sin2", "cos2")
    revolute: ClassVar[Prior | None] = Prior("rad", 1e-4)

    def features(self, readings: Readings) -> Floats:
        """Return sine and cosine of the angle and of twice the angle."""
        q = self.turns(readings)[:, :: len(self.words)]
        features = np.stack([np.sin(q), np.cos(q), np.sin(2.0 * q), np.cos(2.0 * q)], axis=2)
        return features.reshape(len(q), len(self))

    def slopes(self, readings: Readings) -> Floats:
        """Return the derivatives of sine and cosine."""
        q = self.turns(readings)[:, :: len(self.words)]
        slopes = np.stack([np.cos(q), -np.sin(q), 2.0 * np.cos(2.0 * q), -2.0 * np.sin(2.0 * q)], axis=2)
        result: Floats = (slopes.reshape(len(q), len(self)) * self.rate)[:, :, None] * self.selection
        return result

    @property
    def rate(self) -> Floats:
        """(k,) of the angle that errors repeat with, for one of the joint."""
        return np.ones(len(self))

    def turns(self, readings: Readings) -> Floats:
        """Return the angle (N, k) that errors repeat with. [rad]."""
        return self.read(readings.q)

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say how much."""
        return (
            f"{joint.name} errs with its own angle, {1e3 * np.hypot(*p):.2g} mrad, "
            f"{'once' if group == 'harmonic 1' else 'twice'} a turn: encoder eccentricity, or the gear's error"
        )

    def sentence_of_all(self, joints: str, most: float) -> str:
        """Say how much."""
        return f"errors of {joints} with their own angle, by up to {most:.2g} mrad: encoder eccentricity, or gears"

    def shows(self, joint: Joint, q: Floats) -> bool:
        """Return whether the joint turns so far that harmonics do not look like a zero offset or a gear ratio."""
        return bool(np.ptp(q) > _TURN)
