"""Joints that branch: two arms, a head that watches a hand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.robot.chain import Chain
from urdfcal.robot.drawing import draw_urdf
from urdfcal.robot.mechanism import BASE, Joint, Mechanism, Tip

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.robot.urdf.urdf import Urdf


@dataclass(frozen=True, eq=False)
class Tree(Mechanism):
    """One-degree-of-freedom joints between a base link and several others.

    Attributes:
        name: the robot's.
        base_link: link whose frame everything starts from; anywhere in the URDF's tree.
        joints: those to the first tip, from the base outwards, then those to the second that are new, and so on.
        parents: index of the joint that each hangs on, ``BASE`` for the base link.
        placements: (n, 4, 4) T_parent_joint at zero joint value; of those that hang on the base link in its frame. [m]
        tips: the other links.
    """

    name: str
    base_link: str
    joints: tuple[Joint, ...]
    parents: tuple[int, ...]
    placements: Floats
    tips: tuple[Tip, ...]

    def __post_init__(self) -> None:
        if not self.joints:
            raise RobotError(
                f"no movable joint between {self.base_link!r} and {', '.join(repr(tip.link) for tip in self.tips)}",
                where=self.name,
            )
        object.__setattr__(self, "placements", frozen(self.placements))

    @classmethod
    def from_urdf(cls, urdf: Urdf, tip_links: Sequence[str], base_link: str | None = None) -> Tree:
        """Read the joints between a base link and several others from a URDF, through Pinocchio.

        Args:
            urdf: the description.
            tip_links: the others, the most important one first.
            base_link: an ancestor of them all; the root link by default.

        Raises:
            RobotError: a link is unknown, the base is not above a tip, or a joint in between cannot be calibrated
                (floating, planar, zero axis, mimic of a joint that is not in between).
        """
        return cls(*draw_urdf(urdf, tip_links, base_link))

    @property
    def tip_link(self) -> str:  # type: ignore[override]  # nobody writes to it
        """The first tip's."""
        return self.tips[0].link

    @property
    def branches(self) -> tuple[tuple[int, ...], ...]:
        """The joints cut into serial runs, each hanging on a joint of an earlier one, or on the base link.

        A run begins where a joint is not the first to hang on its parent.
        """
        runs: list[list[int]] = []
        continued: set[int] = set()
        run_of: dict[int, list[int]] = {}
        for joint, parent in enumerate(self.parents):
            if parent != BASE and parent not in continued:
                run_of[joint] = run_of[parent]
            else:
                run_of[joint] = []
                runs.append(run_of[joint])
            continued.add(parent)
            run_of[joint].append(joint)
        return tuple(map(tuple, runs))


def with_placements(mechanism: Mechanism, placements: Floats) -> Mechanism:
    """The same joints placed otherwise: (n, 4, 4), m."""
    if isinstance(mechanism, (Chain, Tree)):
        return replace(mechanism, placements=placements)
    raise TypeError(f"{type(mechanism).__name__} is no mechanism that can be copied")


def read_mechanism(urdf: Urdf, tip_links: Sequence[str], base_link: str | None = None) -> Mechanism:
    """Read a chain where one link is asked for, else a tree; see :meth:`Tree.from_urdf`."""
    links = list(dict.fromkeys(tip_links))
    return Chain.from_urdf(urdf, links[0], base_link) if len(links) == 1 else Tree.from_urdf(urdf, links, base_link)
