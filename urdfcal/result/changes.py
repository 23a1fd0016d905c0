"""Whether an arm has changed between two calibrations of it, and where (METHOD 13)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import erfc, sqrt
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import RobotError
from urdfcal.estimation.evaluation import Spread, compare_tips
from urdfcal.result.compared_arms import ComparedArm, ComparedArms
from urdfcal.robot.mechanism import BASE
from urdfcal.robot.placements import AXES, PlacementTable
from urdfcal.robot.tree_dh import rows_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.mechanism import Mechanism

# The chance that any parameter of an arm that is the same seems to have changed.
_CHANCE = 0.01
# Tips of an arm that is the same are so many times farther apart than the upper ends of both errors' intervals, squared
# and summed: of 120 pairs of sessions of ur5s 10 were beyond 1, 1 beyond 1.25.
_BEYOND = 1.25
_POSES = 1000
# By less a tip is moved by rounding, as a lag does at rest. [m]
_UNMOVED = 1e-9
# Nominal placements that differ by no more are the same through different roundings. [m, entries of the rotation]
_SAME = 1e-6


@dataclass(frozen=True)
class ParameterChange:
    """A parameter of the arm in two calibrations.

    Attributes:
        joint: whose it is.
        parameter: its name, such as theta, or lag.
        unit: its SI unit; 1 of a plain number.
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

    @property
    def thousandth(self) -> str:
        """What a thousandth of its unit is called."""
        return "1e-3" if self.unit == "1" else f"m{self.unit}"

    def __str__(self) -> str:
        size = f"{self.change:.2g}" if self.unit == "1" else f"{1e3 * self.change:.2g} {self.thousandth}"
        return f"{self.joint}.{self.parameter} by {size} ({self.sigmas:.0f} sigma)"


@dataclass(frozen=True)
class ArmChanges:
    """Two calibrations of an arm, compared.

    Attributes:
        parameters: those that both have estimated, and of joint models those that one has found and the other not.
        alone: names of those that only one of them has, or that are of something else in each.
        unfound: names of those of joint models that one has found, and the other has looked for in vain: they are
            compared with what they would be there.
        rigid: whether the tips are those without joint models: nobody knows the torques that one gives way to.
        unloaded: whether the tips are those of arms that carry nothing: they carried different things.
        unseen: joints whose zero offset is not among those compared: a change of it is not seen.
        tips: distances between the tips over the workspace, by tip link, after the best alignment at the base. [m]
        expected: what the rms of the tip's distances is at most, by both calibrations' claimed errors, if nothing has
            changed; None where one does not say. [m]
        joints: rms of the tip's displacement at rest by the significant changes of each joint alone, the largest first;
            lag and backlash, which act on an arm that came from elsewhere, have none. [m]
    """

    parameters: tuple[ParameterChange, ...]
    alone: tuple[str, ...]
    unfound: tuple[str, ...]
    rigid: bool
    unloaded: bool
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
    arms = ComparedArms.of(a, b)
    of_a, of_b = _estimated(a), _estimated(b)
    unfound_a = _unfound(of_b, of_a, a)
    unfound_b = _unfound(of_a, of_b, b)
    of_a, of_b = {**of_a, **unfound_a}, {**of_b, **unfound_b}
    common = [key for key in of_a if key in of_b and of_a[key].alike(of_b[key])]
    parameters = tuple(_change(key, of_a[key], of_b[key], len(common)) for key in common)
    q = a.chain.readings(a.chain.random_values(_POSES, np.random.default_rng(seed)))
    first, second = arms.both()
    moving = dict.fromkeys(p.joint for p in parameters if p.significant)
    joints = {joint: _tips(a.chain, first, _with_changes(a, arms, parameters, joint), q) for joint in moving}
    farthest = {joint: max(tip.rms for tip in tips.values()) for joint, tips in joints.items()}
    farthest = {joint: moved if moved > _UNMOVED else 0.0 for joint, moved in farthest.items()}
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
        alone=tuple(".".join(key) for key in dict.fromkeys([*of_a, *of_b]) if key not in common),
        unfound=tuple(".".join(key) for key in [*unfound_a, *unfound_b]),
        rigid=arms.rigid,
        unloaded=arms.unloaded,
        unseen=() if _whole(parameters) else _unseen(a.chain, parameters),
        tips=_tips(a.chain, first, second, q),
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


def _tips(chain: Mechanism, a: ComparedArm, b: ComparedArm, q: Floats) -> dict[str, Spread]:
    """Distances of each tip that moves; those of the first one alone where none does."""
    tips = [tip for k, tip in enumerate(chain.tips) if not k or tip.joint != BASE]
    each = zip(tips, a.frames(q, tips), b.frames(q, tips), strict=True)
    return {tip.link: Spread.of(compare_tips(first, second).position) for tip, first, second in each}


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


@dataclass(frozen=True)
class _Estimated:
    """A parameter's offset and standard deviation [unit], and what a joint model's was estimated with."""

    offset: float
    sigma: float
    unit: str
    inputs: Mapping[str, float | list[list[float]]] = field(default_factory=dict)

    def alike(self, other: _Estimated) -> bool:
        """Return whether both are of the same: not of different gear ratios, or mixtures of torques."""
        return self.inputs == other.inputs


def _estimated(of: Calibration) -> dict[tuple[str, str], _Estimated]:
    document, bends = of.document, of.joint_models
    found = {(e.joint, e.parameter): _Estimated(e.offset, e.sigma, e.unit) for e in document.dh if e.sigma}
    for model, block in zip(bends.found, bends.models, strict=True):
        entries = [(joint, document.joint_models[joint][block.name]) for joint in model.joints]
        each = [
            (joint, entry.inputs, value, sigma)
            for joint, entry in entries
            for value, sigma in zip(entry.values, entry.sigma, strict=True)
        ]
        for (joint, inputs, value, sigma), name, unit in zip(each, block.names, block.units, strict=True):
            if sigma:
                found[joint, name.removeprefix(f"{joint}.")] = _Estimated(value, sigma, unit, inputs)
    return found


def _unfound(
    theirs: Mapping[tuple[str, str], _Estimated], mine: Mapping[tuple[str, str], _Estimated], of: Calibration
) -> dict[tuple[str, str], _Estimated]:
    """What the other calibration's parameters of joint models are in this one, which has looked for them in vain."""
    sought = {name: c for trial in of.document.joint_model_trials for name, c in trial.candidates.items()}
    return {
        key: replace(value, offset=candidate.value, sigma=candidate.sigma)
        for key, value in theirs.items()
        # Mixtures of torques, and gear ratios, are of one session.
        if key not in mine and not value.inputs and (candidate := sought.get(".".join(key))) is not None
    }


def _change(key: tuple[str, str], a: _Estimated, b: _Estimated, count: int) -> ParameterChange:
    sigma = sqrt(a.sigma**2 + b.sigma**2)
    chance = erfc(abs(b.offset - a.offset) / sigma / sqrt(2.0))
    return ParameterChange(*key, a.unit, (a.offset, b.offset), sigma, chance * count < _CHANCE)


def _with_changes(
    a: Calibration, arms: ComparedArms, parameters: tuple[ParameterChange, ...], joint: str
) -> ComparedArm:
    """The first arm with the significant changes of one joint, each joint model as a whole."""
    moved = [p for p in parameters if p.joint == joint and p.significant]
    table = PlacementTable(a.chain) if _whole(parameters) else rows_of(a.chain)
    offsets = np.zeros((len(table.labels), len(table.columns)))
    for entry in a.document.dh:
        offsets[table.labels.index(entry.joint), table.columns.index(entry.parameter)] = entry.offset
    rows = [p for p in moved if p.parameter in table.columns]
    for p in rows:
        offsets[table.labels.index(p.joint), table.columns.index(p.parameter)] = p.offsets[1]
    placements = table.placements(offsets) if rows else a.placements
    return arms.with_joint(joint, placements, {p.parameter.partition(".")[0] for p in moved if p not in rows})
