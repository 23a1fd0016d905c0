"""What the data cannot tell: rank of the whitened Jacobian, and which parameters to hold for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import threadpoolctl

from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.words import sentence

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Geometry, Parameters
    from urdfcal.estimation.state import State

# Singular values of the column-normalised Jacobian below this share of the largest are lost directions. On the
# shipped rigs, LEDs on the last axis included, lost ones come out below 1e-12 (axes of a URDF with rpy to eleven
# digits) and the weakest direction that is told above 1e-3.
_LOST = 1e-8
# Normalising a column to 1 would make rounding look like information; smaller ones are divided by this share of
# the largest column.
_LEAST_NORM = 1e-3
# A column that others reproduce to this is theirs.
_EXPLAINED = 1e-6
# A parameter takes part in a lost direction when its share of it is above rounding.
_PART = 1e-5
# ... can stand for it when its share is no small one: with a length of millimetres held as drawn, an arm of one metre
# would take its scale from it (robots/tiago: d of arm_2_joint is 15 mm, and 1 mm off 7 % of everything) ...
_HELD_PART = 0.1
# ... and is worth naming when it is more than this share of the largest.
_NAMED_PART = 0.05
_ORDER = ("d", "a", "theta", "alpha", "beta", "z", "x", "y", "rz", "rx", "ry")
_BLOCK = 1024
# Poses of each LED in each camera: more tell the same directions, only more surely, and cost a pass over all of them.
_ENOUGH = 200


@dataclass(frozen=True, eq=False)
class Identifiability:
    """What was measured tells about the active parameters: sightings, LED distances, cameras calibrated before.

    Tolerances are no measurement.

    Attributes:
        parameters: the packing, with what only a nominal value can tell held at it.
        rank: number of parameters that the sightings tell.
        condition_number: of the column-normalised whitened Jacobian of those.
        observability: indices O1 to O5, the larger the better the poses were chosen.
        lost: one sentence for each lost direction.
    """

    parameters: Parameters
    rank: int
    condition_number: float
    observability: tuple[float, float, float, float, float]
    lost: tuple[str, ...]


def identify(table: Geometry, blocks: Sequence[Observations], state: State, parameters: Parameters) -> Identifiability:
    """Find the directions that the sightings cannot tell, and hold a parameter for each.

    Of thousands of poses an even selection serves; the indices describe that.

    Of the parameters that take a fair part in a lost direction, the first in the order d, a, theta, alpha, beta, inner
    rows first, is named for it, so that two runs agree; then LED coordinates, then the base. It is held at its nominal
    value unless several DH parameters with tolerances share the direction (as all lengths share the scale that one
    camera cannot tell): their tolerances then say more together than one nominal value.
    """
    with threadpoolctl.threadpool_limits(1, user_api="blas"):  # two threads are slower at these sizes
        blocks = [block.at(block.spread(_ENOUGH)) for block in blocks]
        R = _triangle(table, blocks, state, parameters)
    rows = sum(block.dimension * block.count for block in blocks)
    columns = np.flatnonzero(parameters.active)
    R = R * parameters.scales(state)[columns]
    norms = np.linalg.norm(R, axis=0)
    R = R / np.maximum(norms, _LEAST_NORM * norms.max())
    order = sorted(range(len(columns)), key=lambda k: _rank_key(parameters, int(columns[k])))
    tolerated = (columns < len(parameters.rows)) & np.isfinite(parameters.prior[columns])
    kept = np.ones(len(columns), dtype=bool)
    held: dict[int, str] = {}
    lost: list[str] = []
    while True:
        _, singular, Vt = np.linalg.svd(R[:, kept], full_matrices=True)
        singular = np.pad(singular, (0, Vt.shape[0] - len(singular)))
        null = Vt[singular <= _LOST * singular[0]]
        if not len(null):
            break
        share = np.zeros(len(columns))
        share[kept] = np.linalg.norm(null, axis=0)
        victim = next(k for k in order if share[k] > _HELD_PART * share.max())
        direction = _direction(R, kept, victim, columns, parameters)
        part = np.abs(direction) > _NAMED_PART * np.abs(direction).max()
        partners = [int(columns[k]) for k in np.argsort(-np.abs(direction), kind="stable") if k != victim and part[k]]
        hold = bool(np.count_nonzero(tolerated & (np.abs(direction) > _PART)) <= 1)
        text = sentence(table, parameters, int(columns[victim]), partners, held=hold)
        if hold:
            held[int(columns[victim])] = text
        lost.append(text)
        kept[victim] = False
    left = singular[: np.count_nonzero(kept)]
    return Identifiability(
        parameters=parameters.holding(held),
        rank=int(np.count_nonzero(kept)),
        condition_number=float(left[0] / left[-1]),
        observability=_observability(left, rows),
        lost=tuple(lost),
    )


def _direction(R: Floats, kept: Bools, victim: int, columns: Ints, parameters: Parameters) -> Floats:
    """A lost direction through one parameter, with as simple a company as there is: base, LEDs, both, ... everything.

    The null space itself mixes directions that have nothing to do with each other.
    """
    rows = columns < len(parameters.rows)
    base = (columns >= parameters.base.start) & (columns < parameters.base.stop)
    leds = (columns >= parameters.base.stop) & (columns < parameters.base.stop + 3 * parameters.leds)
    direction = np.zeros(len(columns))
    for company in (base, leds, base | leds, ~rows, rows, np.ones_like(rows)):
        others = company & kept & (np.arange(len(columns)) != victim)
        shares = np.linalg.lstsq(R[:, others], R[:, victim], rcond=_LOST)[0]
        direction[:] = 0.0
        direction[victim], direction[others] = 1.0, -shares
        if np.linalg.norm(R @ direction) < _EXPLAINED:
            break
    return direction


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


def _triangle(table: Geometry, blocks: Sequence[Observations], state: State, parameters: Parameters) -> Floats:
    """R of the whitened Jacobian's QR, block by block: squaring it would hide singular values below 1e-8."""
    R = parameters.measured_jacobian(state)
    for block in blocks:
        W = np.linalg.inv(np.linalg.cholesky(block.covariance))
        tangent = Tangent.at(table, block, state, parameters)
        for first in range(0, len(block.pose), _BLOCK):
            poses = slice(first, first + _BLOCK)
            J = W[poses] @ tangent.linearise(poses).J
            R = np.asarray(np.linalg.qr(np.vstack([R, J.reshape(-1, parameters.count)]), mode="r"))
    return R


def _rank_key(parameters: Parameters, index: int) -> tuple[int, int]:
    if index < len(parameters.rows):
        row, name = parameters.rows[index]
        return (_ORDER.index(name), row)
    inner = index - parameters.base.stop
    return (len(_ORDER) + (0 if inner >= 0 else 1), index)
