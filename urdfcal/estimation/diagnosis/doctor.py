"""Find what happened, when and where: the effects that explain most of the residuals (METHOD 15)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.diagnosis.effects import drifts, effects, subjects
from urdfcal.estimation.diagnosis.residuals import Unexplained, column_scale, solve_score
from urdfcal.session.exclusion import in_words
from urdfcal.session.moves import BASE_LINK, session_name
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.estimation.diagnosis.effects import Effect, Subject
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


_CHANGES = {
    "joint": "the encoder jumped",
    "led": "it slipped",
    "target": "it slipped",
    "camera": "it was bumped",
    "base": "the base, or what all cameras stand on, was bumped",
}


@dataclass(frozen=True, eq=False)
class _Test:
    """What an effect of ``count`` sizes explains; its words and its columns (R + P, k) are made where it is named.

    Of a jump it is known what jumped, and before which pose.
    """

    name: str
    gain: float
    count: int
    sentence: Callable[[], str]
    columns: Callable[[], Floats]
    pose: int | None = None
    subject: Subject | None = None


def diagnose(session: Session, unexplained: Unexplained) -> tuple[Finding, ...]:
    """Name what explains the residuals of an estimate beyond chance, the largest share first."""
    left, total, findings = unexplained, unexplained.total, []
    problem, state = left.problem, left.state
    steady = [
        (effect, left.columns(effect.columns))
        for effect in (*effects(session, problem, state), *drifts(session, problem, state))
    ]
    sudden = [
        (subject, left.columns(subject.columns))
        for subject in (subjects(session, problem, state) if not isinstance(session.motion, Trajectory) else ())
    ]
    for _ in range(_CAUSES):
        tests = [
            *(_explained(left, effect, columns) for effect, columns in steady),
            *(test for subject, columns in sudden for test in _changes(left, session, subject, columns)),
        ]
        if not tests:
            break
        best = max(tests, key=lambda test: _evidence(test, left))
        chance = _chance(best, left, len(tests))
        if chance > _CHANCE:
            break
        what = best.name.partition(":")[0]
        near = [test for test in tests if test.gain > _ALIKE * best.gain]
        alike = tuple(dict.fromkeys(test.name for test in near if test.name.partition(":")[0] != what))
        sentence = best.sentence() + _advice(session, best, near)
        findings.append(Finding(best.name, sentence, best.gain / total, chance, best.pose, alike))
        left = left.less(best.columns())
    return tuple(findings)


def _explained(left: Unexplained, effect: Effect, columns: Floats) -> _Test:
    """Test an effect in all poses."""
    gain, size, _ = left.explained(columns)
    return _Test(effect.name, gain, columns.shape[1], partial(effect.sentence, size), lambda: columns)


def _changes(left: Unexplained, session: Session, subject: Subject, columns: Floats) -> Iterator[_Test]:
    """Test a jump of something before each pose, by sums over the poses from there on."""
    measured, scale = len(left.pose), column_scale(columns)
    B, Q, r = columns[:measured] / scale, left.Q[:measured], left.r[:measured]
    poses = np.unique(left.pose)
    rows = np.searchsorted(poses, left.pose)

    def from_pose(values: Floats) -> Floats:
        """Sum (R, ...) over the rows of each pose and all later ones, (poses, ...)."""
        by_pose = np.zeros((len(poses), *values.shape[1:]))
        np.add.at(by_pose, rows, values)
        return np.cumsum(by_pose[::-1], axis=0)[::-1]

    def sentence(size: Floats, pose: int) -> str:
        moved = f"{subject.called} is {subject.size(size)} from where it was before"
        return f"from pose {_pose(session, pose)} on {moved}: {_CHANGES[subject.kind]}"

    def changed(pose: int) -> Floats:
        later = np.array(columns)
        later[:measured][left.pose < pose] = 0.0
        return later

    grams = from_pose(B[:, :, None] * B[:, None, :])
    inside = from_pose(Q[:, :, None] * B[:, None, :])
    scores = from_pose(B * r[:, None])
    seen = np.unique(rows[np.abs(B).max(axis=1) > 0.0])
    for first, pose in enumerate(poses.tolist()):
        if min(np.sum(seen < first), np.sum(seen >= first)) >= _SIDE:
            gram = grams[first] - inside[first].T @ inside[first]
            gain, size, _ = solve_score(gram, scores[first], scale)
            name, count = f"{subject.called}: change", columns.shape[1]
            yield _Test(name, gain, count, partial(sentence, size, pose), partial(changed, pose), pose, subject)


def _pose(session: Session, pose: int) -> str:
    """What a sentence calls a pose: of several sessions it says which one's."""
    return session.poses[pose] if len(session.parts) > 1 else session.label(pose)


def _advice(session: Session, best: _Test, near: Sequence[_Test]) -> str:
    """Say how to do without a jump: by what is another thing from then on, or without the poses on its shorter side.

    Of what cannot be told apart, something that may be another thing is as good an explanation as a joint.
    """
    if best.pose is None or best.subject is None:
        return ""
    name = session_name(session.parts[session.part[best.pose]])
    mine = [k for k, part in enumerate(session.part) if session_name(session.parts[part]) == name]
    labels = [session.poses[k].removeprefix(f"{name}/") for k in mine]
    split = mine.index(best.pose)
    if not split:
        return f"; it was before {name!r}: calibrate this session alone"
    which, shorter = ("these poses", labels[split:])
    if split < len(labels) - split:
        which, shorter = ("the poses before", labels[:split])
    parting = f"leave out {which} ({in_words('exclude', 'poses', shorter)})"
    here = (test.subject for test in (best, *near) if test.pose == best.pose and test.subject is not None)
    # Points are numbered through LEDs and targets: where there are targets, no LED can be another one from then on.
    kinds = ("base", "camera") if session.targets else ("base", "camera", "led")
    movable = next((subject for subject in here if subject.kind in kinds), None)
    if movable is not None:
        thing = BASE_LINK if movable.kind == "base" else movable.name.removeprefix(f"{name}/").partition("@")[0]
        parting = f"say that it moved ({in_words('moved', thing, labels[split : split + 1])}), or {parting}"
    return f"; {parting}{f' in {name!r}' if name else ''}"


def _evidence(test: _Test, left: Unexplained) -> float:
    """Fall of the sum of squares, in units of what is left per degree of freedom, less what chance gives k sizes."""
    noise = max((left.total - test.gain) / max(left.freedom - test.count, 1.0), 1e-300)
    return test.gain / noise - test.count * float(np.log(max(left.freedom, 2.0)))


def _chance(test: _Test, left: Unexplained, tests: int) -> float:
    """Chance that one of so many tests of noise alone explains as much (F test, Bonferroni)."""
    from scipy.special import fdtrc

    rest = max(left.freedom - test.count, 1.0)
    noise = max((left.total - test.gain) / rest, 1e-300)
    return float(min(1.0, tests * fdtrc(test.count, rest, test.gain / test.count / noise)))
