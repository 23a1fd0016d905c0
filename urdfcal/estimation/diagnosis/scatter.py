"""Find measurements that scatter more than the others: a camera, an LED, or what is far away (METHOD 15)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.diagnosis.doctor import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.arrays import Bools
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution
    from urdfcal.session.model import Session

# Chance that any of the comparisons made on a clean session names something.
_CHANCE = 0.002
# A sigma that is this many times wrong for some of the measurements distorts their weights beyond rounding.
_LARGER = 1.5


def scatter(session: Session, problem: Problem, fit: Solution) -> tuple[Finding, ...]:
    """Name the measurements that scatter more than the rest of their kind, the surest of them; none where none do.

    Variances of whitened residuals are compared (F test, Bonferroni). What is measured in one configuration has its
    reading noise in common: it counts once.

    Args:
        session: the names of cameras and LEDs.
        problem: what was measured.
        fit: an estimate, whose outliers do not count.
    """
    from scipy.special import fdtrc

    unit = problem.readings.unit
    found, tests = [], 0
    for observed, norms, kept in zip(problem.observations, fit.norms, fit.kept, strict=True):
        squares = norms**2 / observed.dimension
        for name, which, remedy in _groups(session, problem, fit, observed):
            mine, others = kept & which, kept & ~which
            count, rest = (len(np.unique(unit[observed.pose[of.any(axis=1)]])) for of in (mine, others))
            tests += 1
            if min(count, rest) < 2:
                continue
            usual = float(squares[others].mean())
            ratio = float(squares[mine].mean()) / max(usual, 1e-300)
            chance = float(fdtrc(observed.dimension * count, observed.dimension * rest, ratio))
            share = float(np.sum(squares[mine] - usual) / np.sum(squares[kept]))
            if ratio > _LARGER**2:
                sentence = (
                    f"{name} scatter {np.sqrt(ratio):.2g} times as much as the other {observed.table.kind}: {remedy}"
                )
                found.append(Finding(f"{name}: scatter", sentence, share, chance, None, ()))
    surest = min(found, key=lambda of: of.p, default=None)
    if surest is None or surest.p * tests > _CHANCE:
        return ()
    return (surest,)


def _groups(
    session: Session, problem: Problem, fit: Solution, observed: Observations
) -> Iterator[tuple[str, Bools, str]]:
    """Groups (N, m) of one kind of measurement, each with what to do if it scatters more."""
    kind = observed.table.kind
    own = f"look at them, or give them a larger sigma of their own in {kind}.csv"
    for key, names, of in (("camera", session.rig.names, "camera"), ("led", session.led_names, "LED")):
        index = observed.index.get(key)
        for k in np.unique(index[observed.valid]) if index is not None else ():
            yield f"the {kind} {'by' if key == 'camera' else 'of'} {of} {names[k]!r}", index == k, own
    if "camera" in observed.index:
        depth = problem.metres_per_unit(observed, fit.state)
        middle = float(np.median(depth[observed.valid]))
        yield f"the {kind} of the farther half", depth > middle, "a small or blurred spot, or the distortion"
