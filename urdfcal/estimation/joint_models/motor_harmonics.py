"""Harmonics of the motor: a joint errs once and twice a turn of its motor, many times a turn of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.estimation.joint_models.harmonics import Harmonics

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.estimation.joint_models.linear import Setting
    from urdfcal.robot.mechanism import Joint
    from urdfcal.session.model import Positions


@dataclass(frozen=True, eq=False)
class MotorHarmonics(Harmonics):
    """A strain-wave gear errs twice a turn of its motor, the motor's encoder once; known are gear ratios.

    Catalogues give 0.5 to 1.5 minutes of arc from peak to peak (Harmonic Drive CSF, CSG): amplitudes of 0.1 mrad or so.

    Attributes:
        ratio: (k,) turns of the motor for one of the parameter's joint.
    """

    name: ClassVar[str] = "motor_harmonics"
    needs: ClassVar[str] = "gear_ratio of a joint that turns"
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = {"motor harmonic 1": (0, 1), "motor harmonic 2": (2, 3)}

    ratio: Floats = field(kw_only=True)

    @classmethod
    def concerns(cls, session: Positions, joint: Joint) -> bool:
        """Return whether the joint's gear ratio is given."""
        return joint.name in session.gear_ratio

    @classmethod
    def depends_on(cls, session: Positions) -> dict[str, Any]:
        """Take the gear ratios."""
        joints = [joint for joint in session.chain.actuated_joints if not joint.prismatic]
        ratios = [session.gear_ratio[joint.name] for joint in joints if cls.concerns(session, joint)]
        return {"ratio": np.repeat(ratios, len(cls.words))}

    @classmethod
    def again(cls, setting: Setting, inputs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Take the gear ratios that were kept."""
        return {"ratio": np.repeat([of["gear_ratio"] for of in inputs], len(cls.words))}

    def inputs(self, columns: Bools) -> dict[str, Any]:
        """Keep the gear ratio."""
        return {"gear_ratio": float(self.ratio[columns][0])}

    def turns(self, readings: Readings) -> Floats:
        """Return the motor's angle."""
        return self.read(readings.q) * self.ratio

    @property
    def rate(self) -> Floats:
        """(k,) the gear ratio."""
        return self.ratio

    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say how much."""
        times = "once" if group == "motor harmonic 1" else "twice"
        return (
            f"{joint.name} errs with its motor's angle, {1e3 * np.hypot(*p):.2g} mrad, {times} a turn: its gear's error"
        )

    def sentence_of_all(self, joints: str, most: float) -> str:
        """Say how much."""
        return f"errors of {joints} with their motor's angle, by up to {most:.2g} mrad: gears"
