"""The parameters of an estimate: a tuple of blocks, packed into one vector (METHOD 7)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Bools, Floats, frozen
from urdfcal.estimation.blocks.arm import ArmBlock
from urdfcal.estimation.blocks.base_pose import BaseBlock, base_keys
from urdfcal.estimation.blocks.known_distances import KnownDistances
from urdfcal.estimation.blocks.leds import LEDS, LedsBlock
from urdfcal.estimation.blocks.places import PLACES
from urdfcal.estimation.blocks.scale import ScaleBlock
from urdfcal.estimation.blocks.targets import target_blocks
from urdfcal.names import check_names

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.estimation.blocks.base import Block
    from urdfcal.estimation.model_spec import ModelSpec
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.state import Key, State
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False)
class Parameters:
    """The packing of the estimated part of a ``State`` into one vector of P entries, ``count`` of them active.

    Attributes:
        blocks: whose coordinates the entries are, in order.
        correlation: (P, P) of the priors' errors: cameras calibrated together err together.
        measured: (P,) whose prior is a measurement made beforehand and no tolerance.
        distances: known between LEDs, and between places.
    """

    blocks: tuple[Block[Any], ...]
    correlation: Floats
    measured: Bools
    distances: tuple[KnownDistances, ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of every entry."""
        return tuple(name for block in self.blocks for name in block.names)

    @cached_property
    def active(self) -> Bools:
        """(P,) which entries are estimated; the others keep their value."""
        return frozen(np.concatenate([block.active for block in self.blocks]), bool)

    @cached_property
    def prior(self) -> Floats:
        """(P,) standard deviation about the nominal value; inf where there is no prior. [unit of the entry]."""
        return frozen(np.concatenate([block.sigma for block in self.blocks]))

    @property
    def size(self) -> int:
        """P, the number of entries."""
        return len(self.names)

    @cached_property
    def count(self) -> int:
        """Number of active entries."""
        return int(np.count_nonzero(self.active))

    @cached_property
    def _columns(self) -> dict[Key[Any], slice]:
        ends = np.cumsum([0, *(len(block) for block in self.blocks)]).tolist()
        return {block.key: slice(*ends[k : k + 2]) for k, block in enumerate(self.blocks)}

    @cached_property
    def _active_columns(self) -> dict[Key[Any], tuple[slice, Bools]]:
        before = np.concatenate([[0], np.cumsum(self.active)])
        return {
            key: (slice(int(before[of.start]), int(before[of.stop])), self.active[of])
            for key, of in self._columns.items()
        }

    def columns(self, key: Key[Any]) -> slice:
        """Return the entries of a block; none if it has no part in the estimate."""
        return self._columns.get(key, slice(0, 0))

    def active_columns(self, key: Key[Any]) -> tuple[slice, Bools]:
        """Return a block's place among the active entries, and which of its coordinates they are."""
        return self._active_columns.get(key, (slice(0, 0), np.zeros(0, bool)))

    def has_active(self, key: Key[Any]) -> bool:
        """Return whether a coordinate of a block is active."""
        where, _ = self.active_columns(key)
        return bool(where.stop > where.start)

    def owner(self, entry: int) -> tuple[int, int]:
        """Return the position of the block that an entry belongs to, and its index in there."""
        position = int(np.searchsorted(self._starts, entry, side="right")) - 1
        return position, entry - int(self._starts[position])

    @cached_property
    def _starts(self) -> Floats:
        return np.cumsum([0, *(len(block) for block in self.blocks[:-1])])

    @cached_property
    def arm_rows(self) -> tuple[tuple[int, str], ...]:
        """(row index, parameter) of the arm's active offsets."""
        arm = next((block for block in self.blocks if isinstance(block, ArmBlock)), None)
        return () if arm is None else tuple(row for row, on in zip(arm.rows, arm.active, strict=True) if on)

    @cached_property
    def reasons(self) -> dict[str, str]:
        """Why entries are not active, by their name."""
        return {name: why for block in self.blocks for name, why in block.reasons.items()}

    def fixing(self, entries: Mapping[int, str]) -> Parameters:
        """Return the same packing with more entries fixed at their value, each for a reason."""
        reasons: list[dict[int, str]] = [{} for _ in self.blocks]
        for entry, why in entries.items():
            position, k = self.owner(entry)
            reasons[position][k] = why
        blocks = zip(self.blocks, reasons, strict=True)
        return replace(self, blocks=tuple(block.fixing(why) if why else block for block, why in blocks))

    def including(self, blocks: Sequence[Block[Any]]) -> Parameters:
        """Return the packing with further blocks at its end, in place of those of the same unknowns."""
        keys = {block.key for block in blocks}
        kept = np.concatenate([np.full(len(block), block.key not in keys) for block in self.blocks])
        more = sum(len(block) for block in blocks)
        correlation = np.eye(int(kept.sum()) + more)
        correlation[: len(correlation) - more, : len(correlation) - more] = self.correlation[np.ix_(kept, kept)]
        return replace(
            self,
            blocks=(*(block for block in self.blocks if block.key not in keys), *blocks),
            correlation=frozen(correlation),
            measured=frozen(np.append(self.measured[kept], np.zeros(more)), bool),
        )

    def scales(self, state: State) -> Floats:
        """Return what brings a unit of each parameter (P,) to about the same effect."""
        return np.concatenate([block.scale(state[block.key]) for block in self.blocks])

    def retract(self, state: State, step: Floats) -> State:
        """Apply a step (count,) of the active entries."""
        full = np.zeros(self.size)
        full[self.active] = step
        steps = [(block, full[self.columns(block.key)]) for block in self.blocks]
        # What does not move is not made anew: a lens as given would take as long as all others together.
        return state.replace({block.key: block.retract(state[block.key], own) for block, own in steps if own.any()})

    def between(self, a: State, b: State) -> Floats:
        """Return the step (count,) of the active entries that leads from one state to another one nearby."""
        steps = [block.between(a[block.key], b[block.key]) for block in self.blocks]
        result: Floats = np.concatenate(steps)[self.active]
        return result

    def sigmas(self, covariance: Floats) -> Floats:
        """Return the standard deviation (P,) of every entry, from the covariance of the active ones; NaN if fixed."""
        sigma = np.full(self.size, np.nan)
        sigma[self.active] = np.sqrt(np.diag(covariance))
        return sigma

    @cached_property
    def _whitening(self) -> tuple[Floats, Bools]:
        """W (p, P), what makes the differences from nominal independent and of unit variance; its measured rows.

        There is a row for every active entry with a prior. Fixed ones stand first in the Cholesky factor: the others'
        rows then are what the prior says of them once those have their value.
        """
        known = np.isfinite(self.prior)
        fixed, active = np.flatnonzero(known & ~self.active), np.flatnonzero(known & self.active)
        order = np.concatenate([fixed, active])
        factor = np.linalg.cholesky(self.correlation[np.ix_(order, order)])
        W = np.zeros((len(active), self.size))
        W[:, order] = np.linalg.inv(factor)[len(fixed) :] / self.prior[order]
        return W, self.measured[active]

    def prior_residuals(self, state: State) -> tuple[Floats, Floats]:
        """Return the whitened differences from the nominal values, and their derivative.

        Returns:
            r (p,) and J (p, count), a row for every active entry with a prior and for every known distance.
        """
        difference, J = self._difference(state)
        W, _ = self._whitening
        distances, J_distances = self._distances(state)
        return np.concatenate([W @ difference, distances]), np.vstack([W @ J, J_distances])[:, self.active]

    def measured_jacobian(self, state: State) -> Floats:
        """Return the derivative (k, count) of what was measured beforehand: known distances and calibrated cameras."""
        W, measured = self._whitening
        return np.vstack([W[measured] @ self._difference(state)[1], self._distances(state)[1]])[:, self.active]

    @property
    def prior_count(self) -> int:
        """Number of priors and measured distances: what counts as measurements beside those of the session."""
        return int(np.count_nonzero(np.isfinite(self.prior) & self.active)) + sum(map(len, self.distances))

    def _difference(self, state: State) -> tuple[Floats, Floats]:
        """How far every entry is from its nominal value (P,), and the derivative (P, P)."""
        full, J = np.zeros(self.size), np.zeros((self.size, self.size))
        for block in self.blocks:
            where = self.columns(block.key)
            full[where], J[where, where] = block.local(state[block.key])
        return full, J

    def _distances(self, state: State) -> tuple[Floats, Floats]:
        rs, Js = [np.zeros(0)], [np.zeros((0, self.size))]
        for known in self.distances:
            r, by_points = known.residuals(state)
            J = np.zeros((len(r), self.size))
            J[:, self.columns(known.key)] = by_points
            rs, Js = [*rs, r], [*Js, J]
        return np.concatenate(rs), np.vstack(Js)


def choose_parameters(session: Session, problem: Problem, state: State, spec: ModelSpec) -> Parameters:
    """List the blocks of an estimate, with tolerances and what was measured of LEDs, targets and cameras as priors.

    Args:
        session: LED, target and camera knowledge, tolerances.
        problem: whose parameters they are.
        state: where priors without a known value are centred.
        spec: which of arm, lenses and camera poses are estimated.

    Raises:
        SessionError: two unknowns have one name, as those of an LED and of a camera that are named alike.
    """
    blocks: list[Block[Any]] = []
    if spec.geometry in ("dh", "full"):
        blocks.append(ArmBlock.of(problem.arm, session.tolerances, priors=spec.priors))
    for model in problem.joint_models:
        block = model.block(session, spec.geometry, [term for term in spec.terms if term.model == model.name])
        if block is not None:
            without = block.toleranced and not spec.priors
            blocks.append(replace(block, sigma=np.full(len(block), np.inf)) if without else block)
    if session.scale_sigma is not None:
        blocks.append(ScaleBlock.of(session.scale_sigma))
    tables = [observed.table for observed in problem.observations]
    by_part = [table.by_part(session.part) for table in tables]
    for k, key in enumerate(base_keys(session.attachments.parts)):
        in_world = any(k in of and of[k].defines_world(session.attachments) for of in by_part)
        why = None if in_world else "nothing is measured in the world: the base link is it"
        blocks.append(BaseBlock.of(fixed=why, key=key))
    blocks.append(LedsBlock.of(session.leds, state[LEDS], priors=spec.priors))
    blocks += target_blocks(session.targets, state, priors=spec.priors)
    # Places that several kinds of measurement name are one block.
    sets = {of.blocks[0].key if of.blocks else of: of for of in (t.blocks(session, spec, state) for t in tables)}
    first = sum(len(block) for block in blocks)
    size = first + sum(len(block) for of in sets.values() for block in of.blocks)
    correlation, measured = np.eye(size), np.zeros(size, dtype=bool)
    for of in sets.values():
        where = slice(first, first + sum(len(block) for block in of.blocks))
        if of.correlation is not None:
            correlation[where, where] = of.correlation
        if of.measured is not None:
            measured[where] = of.measured
        first = where.stop
        blocks += of.blocks
    check_names("unknowns", [name for block in blocks for name in block.names])
    places = session.named("place"), session.place_distances, session.measured_of("place")
    leds = tuple(led.name for led in session.leds)
    distances = (KnownDistances.of(LEDS, leds, session.led_distances), KnownDistances.of(PLACES, *places))
    known = tuple(of for of in distances if len(of))
    return Parameters(tuple(blocks), frozen(correlation), frozen(measured, bool), known)
