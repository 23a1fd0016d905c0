"""Identifiability: rank of the whitened Jacobian, and which parameters to fix for it (METHOD 11)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import one_blas_thread
from urdfcal.errors import CalibrationError
from urdfcal.estimation.linearize import Tangent, fulfilled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.parameters import Parameters
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.state import State

# Singular values of the column-normalised Jacobian below this share of the largest are unidentifiable directions. On
# the shipped rigs, LEDs on the last axis included, these come out below 1e-12 (axes of a URDF with rpy to eleven
# digits) and the weakest direction that is identifiable above 1e-3.
_UNIDENTIFIABLE = 1e-8
# Normalising a column to 1 would make rounding look like information; smaller ones are divided by this share of
# the largest column.
_LEAST_NORM = 1e-3
# A column that others reproduce to this is theirs.
_EXPLAINED = 1e-6
# A parameter takes part in an unidentifiable direction when its share of it is above rounding.
_PART = 1e-5
# ... can stand for it when its share is no small one: with a length of millimetres fixed at nominal, an arm of one
# metre would take its scale from it (robots/tiago: d of arm_2_joint is 15 mm, and 1 mm off 7 % of everything) ...
_FIXED_PART = 0.1
# ... and is worth naming when it is more than this share of the largest.
_NAMED_PART = 0.05
_NAMED = 5
_BLOCK = 1024
# Poses of each LED in each camera: more identify the same directions, only more surely, and cost a pass over all.
_ENOUGH = 200


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Which of the active parameters the measurements identify: those of the session, and those made beforehand.

    Tolerances are no measurement.

    Attributes:
        parameters: the packing, with what only a nominal value can say fixed at it.
        rank: number of identifiable parameters.
        condition_number: of the column-normalised whitened Jacobian of those.
        observability: indices O1 to O5, the larger the better the poses were chosen.
        unidentifiable: one sentence for each unidentifiable direction.
    """

    parameters: Parameters
    rank: int
    condition_number: float
    observability: tuple[float, float, float, float, float]
    unidentifiable: tuple[str, ...]


def identify(problem: Problem, state: State, parameters: Parameters) -> Identifiability:
    """Find the directions that the measurements cannot identify, and fix a parameter for each.

    Of thousands of poses an even selection serves; the indices describe that.

    Of the parameters that take a fair part in an unidentifiable direction, the first in the order of the blocks is
    named for it, so that two runs agree: of the arm's d, a, theta, alpha, beta, inner rows first; then LEDs and
    cameras, then the base. It is fixed at its nominal value unless several parameters with tolerances share the
    direction: their tolerances then say more together than one nominal value. Nor is the scale, which one camera cannot
    identify, fixed where a length has a tolerance, be it one alone: how well it is known is what that tolerance says.

    Raises:
        CalibrationError: an LED is behind a camera there.
    """
    with one_blas_thread():
        problem = problem.spread(_ENOUGH)
        R = _triangle(problem, state, parameters)
    rows = sum(observed.dimension * observed.count for observed in problem.observations)
    columns = np.flatnonzero(parameters.active)
    owners = [parameters.owner(int(column)) for column in columns]
    R = R * parameters.scales(state)[columns]
    if not np.isfinite(R).all():
        remedy = "Check the cameras' order and places, the units of the joint readings, and the tip link."
        raise CalibrationError("the estimate puts an LED behind a camera", remedy=remedy)
    norms = np.linalg.norm(R, axis=0)
    R = R / np.maximum(norms, _LEAST_NORM * norms.max())
    order = sorted(range(len(columns)), key=lambda k: _priority(parameters, *owners[k]))
    of_arm = np.array([parameters.blocks[block].toleranced for block, _ in owners], dtype=bool)
    tolerated = of_arm & np.isfinite(parameters.prior[columns])
    companies = _companies(parameters, np.array([block for block, _ in owners]))
    kept = np.ones(len(columns), dtype=bool)
    fixed: dict[int, str] = {}
    sentences: list[str] = []
    while True:
        _, singular, Vt = np.linalg.svd(R[:, kept], full_matrices=True)
        singular = np.pad(singular, (0, Vt.shape[0] - len(singular)))
        null = Vt[singular <= _UNIDENTIFIABLE * singular[0]]
        if not len(null):
            break
        share = np.zeros(len(columns))
        share[kept] = np.linalg.norm(null, axis=0)
        first = next(k for k in order if share[k] > _FIXED_PART * share.max())
        direction = _direction(R, kept, first, companies)
        part = np.abs(direction) > _NAMED_PART * np.abs(direction).max()
        partners = [int(columns[k]) for k in np.argsort(-np.abs(direction), kind="stable") if k != first and part[k]]
        # A scale that one nominal length says is no better known than that one: fixed, it would count as exact.
        several = 0 if _is_scale(parameters, (int(columns[first]), *partners)) else 1
        fix = bool(np.count_nonzero(tolerated & (np.abs(direction) > _PART)) <= several)
        text = _sentence(parameters, int(columns[first]), partners, fix=fix)
        if fix:
            fixed[int(columns[first])] = text
        sentences.append(text)
        kept[first] = False
    left = singular[: np.count_nonzero(kept)]
    return Identifiability(
        parameters=parameters.fixing(fixed),
        rank=int(np.count_nonzero(kept)),
        condition_number=float(left[0] / left[-1]),
        observability=_observability(left, rows),
        unidentifiable=tuple(sentences),
    )


def _priority(parameters: Parameters, block: int, index: int) -> tuple[int, ...]:
    """Which of the parameters that could stand for a direction does: the lowest."""
    return (parameters.blocks[block].order, block, *parameters.blocks[block].priority(index))


def _companies(parameters: Parameters, owner: Ints) -> list[Bools]:
    """Sets of columns, from simple to rich, in which the partners of a parameter are looked for.

    One block beside the arm, two of them, all of them, the arm, everything. The null space itself mixes directions that
    have nothing to do with each other.
    """
    beside = [k for k, block in enumerate(parameters.blocks) if not block.toleranced]
    beside.sort(key=lambda k: -parameters.blocks[k].order)
    sets = [*((k,) for k in beside), *combinations(beside, 2), tuple(beside)]
    companies = [np.isin(owner, one) for one in sets]
    return [*companies, ~companies[-1], np.ones(len(owner), dtype=bool)]


def _direction(R: Floats, kept: Bools, first: int, companies: Sequence[Bools]) -> Floats:
    """An unidentifiable direction through one parameter, in the simplest company that explains it."""
    direction = np.zeros(len(kept))
    for company in companies:
        others = company & kept & (np.arange(len(kept)) != first)
        shares = np.linalg.lstsq(R[:, others], R[:, first], rcond=_UNIDENTIFIABLE)[0]
        direction[:] = 0.0
        direction[first], direction[others] = 1.0, -shares
        if np.linalg.norm(R @ direction) < _EXPLAINED:
            break
    return direction


def _sentence(parameters: Parameters, first: int, partners: Sequence[int], *, fix: bool) -> str:
    """Say which parameter is unidentifiable, why, and what is done about it.

    Args:
        parameters: the packing.
        first: entry that stands for the direction.
        partners: entries that it cannot be distinguished from, the largest share first.
        fix: whether it is fixed at its nominal value; else tolerances decide.
    """
    outcome = "it is fixed at its nominal value" if fix else "their tolerances decide"
    position, index = parameters.owner(first)
    block, owners = parameters.blocks[position], [parameters.owner(partner) for partner in partners]
    others = {of for of, _ in owners}
    if others <= {position}:
        why = block.unidentifiable(index, [k for _, k in owners])
        if why is not None:
            return f"{why}: {outcome}"
        if not partners:
            return f"{block.label(index)} moves nothing that is measured: {outcome}"
    if _is_scale(parameters, (first, *partners)):
        return (
            f"the scale (all lengths together, {block.label(index)} among them) is unidentifiable without a stereo "
            f"baseline or a known distance: {outcome}"
        )
    if others and position not in others and not any(parameters.blocks[k].toleranced for k in others):
        phrases = list(dict.fromkeys(parameters.blocks[k].phrase for k in sorted(others)))
        if len(phrases) <= 2 and all(phrases):
            return f"{block.label(index)} cannot be distinguished from {' and '.join(phrases)}: {outcome}"
    named = ", ".join(parameters.blocks[of].label(k) for of, k in owners[:_NAMED])
    more = f" and {len(partners) - _NAMED} more" if len(partners) > _NAMED else ""
    return f"{block.label(index)} cannot be distinguished from {named}{more}: {outcome}"


def _is_scale(parameters: Parameters, entries: Sequence[int]) -> bool:
    """Whether lengths take part, along more than one axis: of the arm, and of two others such as LEDs and the base."""
    owners = [parameters.owner(entry) for entry in entries]
    involved = {of for of, _ in owners}
    lengths = all(parameters.blocks[of].units[k] == "m" for of, k in owners)
    beside = [of for of, _ in owners if not parameters.blocks[of].toleranced]
    axes = max((beside.count(of) for of in beside), default=0)
    return lengths and axes > 1 and any(parameters.blocks[of].toleranced for of in involved) and len(involved) > 2


def _observability(singular: Floats, measurements: int) -> tuple[float, float, float, float, float]:
    """O1 ... O5 of Sun & Hollerbach (ICRA 2008), of the column-normalised whitened Jacobian's singular values."""
    geometric = float(np.exp(np.mean(np.log(singular))))
    return (
        geometric / np.sqrt(measurements),
        float(singular[-1] / singular[0]),
        float(singular[-1]),
        float(singular[-1] ** 2 / singular[0]),
        float(1.0 / np.sum(1.0 / singular)),
    )


def _triangle(problem: Problem, state: State, parameters: Parameters) -> Floats:
    """R of the whitened Jacobian's QR, part by part: squaring it would hide singular values below 1e-8."""
    R = parameters.measured_jacobian(state)
    for observed in problem.observations:
        if not observed.table.array:
            observed = fulfilled(problem, observed, state, parameters)
        W = np.linalg.inv(np.linalg.cholesky(observed.covariance))
        tangent = Tangent.at(problem, observed, state, parameters)
        for first in range(0, len(observed.pose), _BLOCK):
            poses = slice(first, first + _BLOCK)
            J = W[poses] @ tangent.linearise(poses).J
            R = np.asarray(np.linalg.qr(np.vstack([R, J.reshape(-1, parameters.count)]), mode="r"))
    return R
