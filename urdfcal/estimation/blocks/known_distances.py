"""Known distances between unknown points: LEDs on a bar, sockets drilled into one plate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.estimation.state import Key, State
    from urdfcal.session.knowledge import LedDistance, PlaceDistance


@dataclass(frozen=True)
class KnownDistances:
    """Distances between the points of a block, measured beforehand: a measurement of these points alone.

    Attributes:
        key: of the block, whose value is (P, 3). [m]
        pairs: (point, point, distance, standard deviation) of each. [m]
        points: P, the number of points.
    """

    key: Key[Floats]
    pairs: tuple[tuple[int, int, float, float], ...]
    points: int

    @classmethod
    def of(
        cls,
        key: Key[Floats],
        names: Sequence[str],
        distances: Sequence[LedDistance] | Sequence[PlaceDistance],
        there: Collection[int] | None = None,
    ) -> KnownDistances:
        """Take a session's distances between points of these names, if both ends are ``there``, by their index."""
        pairs = [(*map(names.index, of.between), of.distance, of.sigma) for of in distances]
        kept = tuple(pair for pair in pairs if there is None or there.issuperset(pair[:2]))  # type: ignore[attr-defined]
        return cls(key, kept, len(names))  # type: ignore[arg-type]

    def __len__(self) -> int:
        """Return the number of distances."""
        return len(self.pairs)

    @property
    def by_scale(self) -> Floats:
        """(k,) how the residuals change with the share by which all distances are too long."""
        return np.array([distance / sigma for _, _, distance, sigma in self.pairs])

    def residuals(self, state: State) -> tuple[Floats, Floats]:
        """Return the differences (k,) in standard deviations, and their derivative (k, 3 P) by the positions."""
        positions, r, J = state[self.key], np.zeros(len(self)), np.zeros((len(self), self.points, 3))
        for k, (a, b, distance, sigma) in enumerate(self.pairs):
            difference = positions[a] - positions[b]
            length = float(np.linalg.norm(difference))
            r[k] = (length - distance) / sigma
            J[k, a] = difference / max(length, 1e-12) / sigma
            J[k, b] = -J[k, a]
        return r, J.reshape(len(self), 3 * self.points)
