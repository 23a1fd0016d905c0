"""Whether an arm has changed between two calibrations of it, and where (METHOD 13)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import erfc, sqrt
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import RobotError
from urdfcal.estimation.evaluation import Spread, compare
from urdfcal.robot.mechanism import BASE
from urdfcal.robot.placements import AXES, PlacementTable
from urdfcal.robot.tree_dh import rows_of

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.result.calibration import Calibration
    from urdfcal.result.document import DHEntry
    from urdfcal.robot.mechanism import Mechanism

# The chance that any parameter of an arm that is the same seems to have changed.
_CHANCE = 0.01
# Tips of an arm that is the same are so many times farther apart than the upper ends of both errors' intervals, squared
# and summed: of 120 pairs of sessions of ur5s 10 were beyond 1, 1 beyond 1.25.
_BEYOND = 1.25
_POSES = 1000
# Nominal placements that differ by no more are the same through different roundings. [m, entries of the rotation]
_SAME = 1e-6


@dataclass(frozen=True)
class ParameterChange:
    """A parameter of the arm in two calibrations.

    Attributes:
        joint: whose row it is in.
        parameter: its name, such as theta.
        unit: m or rad.
        offsets: from the nominal value, in the first calibration and in the second. [unit]
        sigma: standard deviation of their difference. [unit]
        significant: whether they differ beyond chance, all compared parameters considered.
    """

    joint: str
    parameter: str
    unit: str
    offsets: tuple[float, float]
    sigma: float
    significant: bool

    @property
    def change(self) -> float:
        """The second offset less the first. [unit]."""
        return self.offsets[1] - self.offsets[0]

    @property
    def sigmas(self) -> float:
        """Size of the change in standard deviations."""
        return abs(self.change) / self.sigma

    def __str__(self) -> str:
        unit = "mm" if self.unit == "m" else "mrad"
        return f"{self.joint}.{self.parameter} by {1e3 * self.change:.2g} {unit} ({self.sigmas:.0f} sigma)"


@dataclass(frozen=True)
class ArmChanges:
    """Two calibrations of an arm, compared.

    Attributes:
        parameters: those that both have estimated.
        alone: names of those that only one of them has.
        unseen: joints whose zero offset is not among those compared: a change of it is not seen.
        tips: distances between the tips over the workspace, by tip link, after the best alignment at the base. [m]
        expected: what the rms of the tip's distances is at most, by both calibrations' claimed errors, if nothing has
            changed; None where one does not say. [m]
        joints: rms of the tip's displacement by the significant changes of each joint alone, the largest first. [m]
    """

    parameters: tuple[ParameterChange, ...]
    alone: tuple[str, ...]
    unseen: tuple[str, ...]
    tips: dict[str, Spread]
    expected: float | None
    joints: dict[str, float]

    @property
    def significant(self) -> tuple[ParameterChange, ...]:
        """The parameters that changed beyond chance, the most significant first."""
        return tuple(sorted((p for p in self.parameters if p.significant), key=lambda p: -p.sigmas))

    @property
    def chi2(self) -> float:
        """Sum of the squared changes in standard deviations: as many as there are parameters, were they independent."""
        return float(sum(p.sigmas**2 for p in self.parameters))

    @property
    def tip(self) -> Spread:
        """Of the tip that the calibrations are about: the first one."""
        return next(iter(self.tips.values()))

    @property
    def apart(self) -> bool:
        """Whether the tips are farther apart than the calibrations' own errors make likely."""
        return self.expected is not None and self.tip.rms > self.expected

    @property
    def changed(self) -> bool:
        """Whether the arm changed."""
        return self.apart or bool(self.significant)


def find_changes(a: Calibration, b: Calibration, seed: int = 0) -> ArmChanges:
    """Compare two calibrations of one arm.

    Args:
        a: the first one.
        b: the second one, of the same nominal joints.
        seed: of the poses at which the tips are compared.

    Raises:
        RobotError: they are of different robots, or nothing of the arm was estimated in both.
    """
    _check_same_robot(a, b)
    of_a, of_b = _estimated(a), _estimated(b)
    common = [key for key in of_a if key in of_b]
    parameters = tuple(_change(of_a[key], of_b[key], len(common)) for key in common)
    q = a.chain.random_values(_POSES, np.random.default_rng(seed))
    moving = dict.fromkeys(p.joint for p in parameters if p.significant)
    joints = {joint: _tips(a.calibrated, _with_changes(a, parameters, joint), q) for joint in moving}
    farthest = {joint: max(tip.rms for tip in tips.values()) for joint, tips in joints.items()}
    claimed = [of.document.tip for of in (a, b)] if of_a and of_b else [None]
    squares = sum(tip.interval_mm[1] ** 2 for tip in claimed if tip)
    expected = 1e-3 * _BEYOND * sqrt(squares) if all(claimed) else None
    if not common and expected is None:
        raise RobotError(
            "no parameter of the arm was estimated in both calibrations",
            where="compare",
            remedy="Calibrate both sessions with the same estimate: {geometry: dh}.",
        )
    return ArmChanges(
        parameters=parameters,
        alone=tuple(f"{joint}.{name}" for joint, name in [*of_a, *of_b] if (joint, name) not in common),
        unseen=() if _whole(parameters) else _unseen(a.chain, parameters),
        tips=_tips(a.calibrated, b.calibrated, q),
        expected=expected,
        joints=dict(sorted(farthest.items(), key=lambda item: -item[1])),
    )


def _whole(parameters: tuple[ParameterChange, ...]) -> bool:
    """Whether they are of whole placements, which have no zero offset of their own."""
    return any(p.parameter in AXES for p in parameters)


def _unseen(chain: Mechanism, parameters: tuple[ParameterChange, ...]) -> tuple[str, ...]:
    compared, table = {(p.joint, p.parameter) for p in parameters}, rows_of(chain)
    zeros = ((table.labels[row], name) for row, name in table.zeros)
    return tuple(joint for joint, name in zeros if (joint, name) not in compared)


def _tips(a: Mechanism, b: Mechanism, q: Floats) -> dict[str, Spread]:
    """Distances of each tip that moves; those of the first one alone where none does."""
    distances = {}
    for k, tip in enumerate(a.tips):
        if not k or tip.joint != BASE:
            first, second = (replace(of, tips=(of.tips[k], *of.tips[:k], *of.tips[k + 1 :])) for of in (a, b))
            distances[tip.link] = Spread.of(compare(first, second, q).position)
    return distances


def _check_same_robot(a: Calibration, b: Calibration) -> None:
    """Refuse calibrations whose parameters are not offsets from the same nominal joints."""
    mine, theirs = a.chain, b.chain
    names = [name for name in theirs.names if name not in mine.names]
    missing = [name for name in mine.names if name not in theirs.names]
    if names or missing:
        only = [f"only the {which} has {', '.join(of)}" for which, of in (("first", missing), ("second", names)) if of]
        raise _other_robot(f"they have different joints: {'; '.join(only)}")
    if (mine.names, mine.parents) != (theirs.names, theirs.parents):
        raise _other_robot("the same joints hang on each other in another order")
    for what in ("base_link", "tip_link"):
        if getattr(mine, what) != getattr(theirs, what):
            ends = f"{getattr(mine, what)!r} in the first, {getattr(theirs, what)!r} in the second"
            raise _other_robot(f"the {what} is {ends}")
    if [tip.link for tip in mine.tips] != [tip.link for tip in theirs.tips]:
        links = [", ".join(tip.link for tip in of.tips) for of in (mine, theirs)]
        raise _other_robot(f"the first ends in {links[0]}, the second in {links[1]}")
    for k, (joint, other) in enumerate(zip(mine.joints, theirs.joints, strict=True)):
        if (joint.prismatic, joint.mimic) != (other.prismatic, other.mimic) or not _close(joint.axis, other.axis):
            raise _other_robot(f"joint {joint.name!r} has another type, axis or mimic")
        if not _close(mine.placements[k], theirs.placements[k]):
            raise _other_robot(f"the nominal placement of joint {joint.name!r} differs")


def _other_robot(what: str) -> RobotError:
    return RobotError(what, where="compare", remedy="Compare calibrations of one arm, from the same nominal URDF.")


def _close(a: Floats, b: Floats) -> bool:
    return bool(np.allclose(a, b, rtol=0.0, atol=_SAME))


def _estimated(of: Calibration) -> dict[tuple[str, str], DHEntry]:
    return {(entry.joint, entry.parameter): entry for entry in of.document.dh if entry.sigma}


def _change(a: DHEntry, b: DHEntry, count: int) -> ParameterChange:
    sigma = sqrt((a.sigma or 0.0) ** 2 + (b.sigma or 0.0) ** 2)
    chance = erfc(abs(b.offset - a.offset) / sigma / sqrt(2.0))
    return ParameterChange(a.joint, a.parameter, a.unit, (a.offset, b.offset), sigma, chance * count < _CHANCE)


def _with_changes(a: Calibration, parameters: tuple[ParameterChange, ...], joint: str) -> Mechanism:
    """The first arm with the significant changes of one joint."""
    moved = [p for p in parameters if p.joint == joint and p.significant]
    arm = PlacementTable(a.chain) if _whole(parameters) else rows_of(a.chain)
    offsets = np.zeros((len(arm.labels), len(arm.columns)))
    for entry in a.document.dh:
        offsets[arm.labels.index(entry.joint), arm.columns.index(entry.parameter)] = entry.offset
    for p in moved:
        offsets[arm.labels.index(p.joint), arm.columns.index(p.parameter)] = p.offsets[1]
    return a.chain.with_placements(arm.placements(offsets))
