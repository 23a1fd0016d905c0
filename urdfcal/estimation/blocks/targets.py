"""How targets are fastened as unknowns: one pose each, and the scale and the bends of a print."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, inverse
from urdfcal.estimation.blocks.base import POSE_AXES, POSE_UNITS, Block, VectorBlock
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.state import Key
from urdfcal.session.target import bends_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from urdfcal.estimation.state import State
    from urdfcal.session.attachments import Attachments
    from urdfcal.session.target import Target

TARGET_TOLERANCE = (0.02, 0.2)
"""Standard deviations of a target's pose given without any: by ruler and by eye. [m, rad]"""


def target_key(target: str) -> Key[Floats]:
    """Key of a target's pose T_link_target, or T_world_target (4, 4). [m]."""
    return Key(f"{target}.T_link_target")


def print_key(target: str) -> Key[Floats]:
    """Key of the share (1,) that a target's lengths are given too long by."""
    return Key(f"{target}.print")


def bend_key(target: str) -> Key[Floats]:
    """Key of how far (3,) a target's print is bent along x, twisted, and bent along y, at its rim. [m]."""
    return Key(f"{target}.bend")


class TargetBlock(Block[Floats]):
    """The rigid transform of a target in what carries it, which moves by exp6(step) from the right. [m, rad]."""

    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, target: Target, start: Floats, *, priors: bool) -> TargetBlock:
        """Take all six coordinates; those given as exact are fixed.

        Args:
            target: as the session declares it.
            start: (4, 4) where one that is not given is centred; it has no prior. [m]
            priors: whether a given pose acts as a prior.
        """
        given, sigma = target.T_link_target, target.sigma
        if given is None:
            sigma = np.full(6, np.inf)
        elif sigma is None:
            sigma = np.repeat(TARGET_TOLERANCE, 3)
        return cls(
            key=target_key(target.name),
            names=tuple(f"{target.name}.{axis}" for axis in POSE_AXES),
            units=POSE_UNITS,
            nominal=start if given is None else given,
            sigma=np.where((sigma > 0.0) & priors, sigma, np.inf),
            fixed={int(k): "its pose is given as exact" for k in np.flatnonzero(sigma == 0.0)},
            phrase=f"how {target.name} is fastened",
        )

    def retract(self, value: Floats, step: Floats) -> Floats:
        """Multiply by exp6(step) from the right."""
        moved: Floats = value @ pin.exp6(step).homogeneous
        return moved

    def local(self, value: Floats) -> tuple[Floats, Floats]:
        """Return log6(D) of D = nominal^-1 T, and Jlog6(D): exp6(s) moves D from the right."""
        difference = pin.SE3(inverse(self.nominal) @ value)
        return pin.log6(difference).vector, pin.Jlog6(difference)


class PrintBlock(VectorBlock):
    """The share that a target's lengths are given too long by: its print, known to a standard deviation."""

    order: ClassVar[int] = 3

    @classmethod
    def of(cls, target: Target) -> PrintBlock:
        """Take what the session says of it."""
        return cls(
            key=print_key(target.name),
            names=(f"{target.name}.scale",),
            units=("1",),
            nominal=np.zeros(1),
            sigma=np.array([target.scale_sigma or np.inf]),
            fixed={0: "it is given as exact"} if target.scale_sigma == 0.0 else {},
            phrase=f"the scale of {target.name}",
        )


class BendBlock(VectorBlock):
    """How a target's print is bent, known to be flat to a standard deviation. [m]."""

    order: ClassVar[int] = 3

    @classmethod
    def of(cls, target: Target) -> BendBlock:
        """Take what the session says of it."""
        return cls(
            key=bend_key(target.name),
            names=tuple(f"{target.name}.bend_{axes}" for axes in ("xx", "xy", "yy")),
            units=("m",) * 3,
            nominal=np.zeros(3),
            sigma=np.full(3, target.flatness),
            phrase=f"how {target.name} is bent",
        )


def target_blocks(targets: Iterable[Target], state: State, *, priors: bool) -> list[Block[Floats]]:
    """List the blocks of all targets."""
    blocks: list[Block[Floats]] = []
    for target in targets:
        blocks.append(TargetBlock.of(target, state[target_key(target.name)], priors=priors))
        if target.scale_sigma is not None:
            blocks.append(PrintBlock.of(target))
        if target.flatness is not None:
            blocks.append(BendBlock.of(target))
    return blocks


def nominal_targets(targets: Iterable[Target]) -> dict[Key[Floats], Floats]:
    """Return the poses of the targets that are given, and prints as they should be."""
    poses = {target_key(of.name): of.T_link_target for of in targets if of.T_link_target is not None}
    prints = {print_key(of.name): np.zeros(1) for of in targets if of.scale_sigma is not None}
    return {**poses, **prints, **{bend_key(of.name): np.zeros(3) for of in targets if of.flatness is not None}}


def point_places(attachments: Attachments, state: State) -> Floats:
    """Positions (L + M, 3) of the LEDs and the targets' points, each in the frame it is fixed in. [m]."""
    leds, points = state[LEDS], attachments.target_points
    if not len(points):
        return leds
    scales = [print_scale(name, state) for name in attachments.targets]
    own = attachments.led[len(leds) :] - attachments.first_target
    for k, name in enumerate(attachments.targets):
        if (bends := bend_key(name)) in state:
            mine = own == k
            points = points.copy()
            points[mine, 2] += bends_of(attachments.target_points[mine]) @ state[bends]
    return np.concatenate([leds, points / np.array(scales)[own, None]])


def print_scale(target: str, state: State) -> float:
    """Return the factor that a target's lengths are given too long by; 1 where it is no unknown."""
    own = print_key(target)
    return 1.0 + float(state[own][0]) if own in state else 1.0
