"""Find what happened, when and where: the effects that explain most of the residuals (METHOD 15)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.diagnosis.effects import drifts, effects, subjects
from urdfcal.estimation.diagnosis.residuals import Unexplained, solve_score
from urdfcal.session.exclusion import in_words
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.arrays import Floats
    from urdfcal.estimation.diagnosis.effects import Subject
    from urdfcal.session.model import Session

# Chance that any of the tests made on a clean session names something.
_CHANCE = 0.005
# Causes named at most, each tested on what the ones before leave.
_CAUSES = 3
# Effects that explain this share of what the best one explains cannot be told from it.
_ALIKE = 0.9
# A change needs this many poses on either side.
_SIDE = 3


@dataclass(frozen=True, eq=False)
class Finding:
    """An effect that explains residuals beyond chance.

    Attributes:
        name: of the effect, short.
        sentence: what happened, when and where.
        share: of the sum of squared residuals that it explains.
        p: chance of as much in a clean session, over all tests made.
        pose: the session's pose from which on, None for what holds in all of them.
        alike: names of effects that explain nearly as much: the residuals do not tell them apart.
    """

    name: str
    sentence: str
    share: float
    p: float
    pose: int | None
    alike: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Tested:
    name: str
    sentence: str
    gain: float
    count: int
    pose: int | None
    columns: Floats


def diagnose(session: Session, unexplained: Unexplained) -> tuple[Finding, ...]:
    """Name what explains the residuals of an estimate beyond chance, the largest share first."""
    left, findings = unexplained, []
    total = left.total
    for _ in range(_CAUSES):
        tested = list(_tests(left, session))
        if not tested:
            break
        chances = [_chance(test, left, len(tested)) for test in tested]
        best = max(range(len(tested)), key=lambda k: _evidence(tested[k], left))
        if chances[best] > _CHANCE:
            break
        found = tested[best]
        alike = [
            test.name
            for test in tested
            if test is not found
            and test.gain > _ALIKE * found.gain
            and test.name.partition(":")[0] != found.name.partition(":")[0]
        ]
        findings.append(
            Finding(
                found.name, found.sentence, found.gain / total, chances[best], found.pose, tuple(dict.fromkeys(alike))
            )
        )
        left = left.less(found.columns)
    return tuple(findings)


def _tests(left: Unexplained, session: Session) -> Iterator[_Tested]:
    problem, state = left.problem, left.state
    for effect in (*effects(session, problem, state), *drifts(session, problem, state)):
        columns = left.columns(effect.columns)
        gain, size, _ = left.explained(columns)
        yield _Tested(effect.name, effect.sentence(size), gain, columns.shape[1], None, columns)
    if not isinstance(session.motion, Trajectory):
        for subject in subjects(session, problem, state):
            yield from _changes(left, session, subject)


def _changes(left: Unexplained, session: Session, subject: Subject) -> Iterator[_Tested]:
    """Test a jump of something before each pose, by sums over the poses from there on."""
    columns = left.columns(subject.columns)
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    measured = len(left.pose)
    B, Q, r = columns[:measured] / scale, left.Q[:measured], left.r[:measured]
    poses = np.unique(left.pose)
    rows = np.searchsorted(poses, left.pose)
    k = B.shape[1]

    def from_pose(values: Floats) -> Floats:
        """Sum (R, ...) over the rows of each pose and all later ones, (poses, ...)."""
        by_pose = np.zeros((len(poses), *values.shape[1:]))
        np.add.at(by_pose, rows, values)
        return np.cumsum(by_pose[::-1], axis=0)[::-1]

    grams = from_pose(B[:, :, None] * B[:, None, :])
    inside = from_pose(Q[:, :, None] * B[:, None, :])
    scores = from_pose(B * r[:, None])
    later = np.ones(len(left.r) - measured, dtype=bool)
    seen = np.unique(rows[np.abs(B).max(axis=1) > 0.0])
    for first in range(len(poses)):
        if min(np.sum(seen < first), np.sum(seen >= first)) < _SIDE:
            continue
        gram = grams[first] - inside[first].T @ inside[first]
        gain, size, _ = solve_score(gram, scores[first], scale)
        pose = int(poses[first])
        sentence = (
            f"from pose {session.label(pose)} on {subject.called} is {subject.size(size)} from where it was before: "
            + {
                "joint": "the encoder jumped",
                "led": "it slipped",
                "camera": "it was bumped",
                "base": "the base, or what all cameras stand on, was bumped",
            }[subject.kind]
            + f"; {_without(session, pose)}"
        )
        yield _Tested(
            f"{subject.called}: change", sentence, gain, k, pose, columns * np.append(left.pose >= pose, later)[:, None]
        )


def _without(session: Session, pose: int) -> str:
    """Say how to do without the change from a pose on: by the poses on its shorter side."""
    before, later = session.poses[:pose], session.poses[pose:]
    which, shorter = ("the poses before", before) if len(before) < len(later) else ("these poses", later)
    return f"leave out {which} ({in_words(shorter)})"


def _evidence(test: _Tested, left: Unexplained) -> float:
    """Fall of the sum of squares, in units of what is left per degree of freedom, less what chance gives k sizes."""
    noise = max((left.total - test.gain) / max(left.freedom - test.count, 1.0), 1e-300)
    return test.gain / noise - test.count * float(np.log(max(left.freedom, 2.0)))


def _chance(test: _Tested, left: Unexplained, tests: int) -> float:
    """Chance that one of so many tests of noise alone explains as much (F test, Bonferroni)."""
    from scipy.special import fdtrc

    rest = max(left.freedom - test.count, 1.0)
    noise = max((left.total - test.gain) / rest, 1e-300)
    return float(min(1.0, tests * fdtrc(test.count, rest, test.gain / test.count / noise)))
