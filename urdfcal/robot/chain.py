"""The serial chain of movable joints between two links, as drawn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.robot.drawing import Drawing, draw_model, draw_urdf
from urdfcal.robot.mechanism import Joint, Mechanism, Tip

if TYPE_CHECKING:
    from pathlib import Path

    import pinocchio as pin

    from urdfcal.robot.urdf.urdf import Urdf


@dataclass(frozen=True, eq=False)
class Chain(Mechanism):
    """A serial chain of one-degree-of-freedom joints from a base link down to a tip link.

    Attributes:
        name: the robot's.
        base_link: link whose frame the chain starts from; anywhere in the tree.
        tip_link: link whose frame it ends in.
        joints: from base to tip.
        placements: (n, 4, 4) T_previous_joint at zero joint value; the first in the base link's frame. [m]
        T_last_tip: (4, 4) the tip link's frame in the last joint's frame. [m]
    """

    name: str
    base_link: str
    tip_link: str
    joints: tuple[Joint, ...]
    placements: Floats
    T_last_tip: Floats

    def __post_init__(self) -> None:
        if not self.joints:
            raise RobotError(
                f"no movable joint between {self.base_link!r} and {self.tip_link!r}",
                where=self.name,
                remedy="Name a base and a tip link with revolute, continuous or prismatic joints in between.",
            )
        object.__setattr__(self, "placements", frozen(self.placements))
        object.__setattr__(self, "T_last_tip", frozen(self.T_last_tip))

    @classmethod
    def from_urdf(cls, urdf: Urdf | str | Path, tip_link: str, base_link: str | None = None) -> Chain:
        """Read the chain from a URDF, through Pinocchio.

        Args:
            urdf: a parsed URDF, or its path or ``package://`` reference.
            tip_link: link at the end of the chain.
            base_link: link at its start, an ancestor of the tip; the root link by default.

        Raises:
            RobotError: the file is no valid URDF, a link is unknown, the base is not above the tip, or a
                joint in between cannot be calibrated (floating, planar, zero axis, mimic of a joint off the chain).
        """
        return cls._from(draw_urdf(urdf, [tip_link], base_link))

    @classmethod
    def from_model(cls, model: pin.Model, tip_link: str, base_link: str | None = None) -> Chain:
        """Copy the chain between two links out of a Pinocchio model; the model is left alone.

        Args:
            model: any model; joints off the chain do not matter.
            tip_link: body frame at the end of the chain.
            base_link: body frame at its start, an ancestor of the tip; the universe's first body by default.

        Raises:
            RobotError: a link is unknown, the base is not above the tip, or a joint in between has not
                exactly one degree of freedom, no axis, or is a mimic joint.
        """
        return cls._from(draw_model(model, [tip_link], base_link))

    @classmethod
    def _from(cls, drawing: Drawing) -> Chain:
        (tip,) = drawing.tips
        return cls(drawing.name, drawing.base_link, tip.link, drawing.joints, drawing.placements, tip.T_joint_link)

    @property
    def parents(self) -> tuple[int, ...]:  # type: ignore[override]  # nobody writes to it
        """Each joint hangs on the one before it."""
        return tuple(range(-1, len(self.joints) - 1))

    @cached_property
    def tips(self) -> tuple[Tip, ...]:  # type: ignore[override]
        """The tip link alone."""
        return (Tip(self.tip_link, len(self.joints) - 1, self.T_last_tip),)
