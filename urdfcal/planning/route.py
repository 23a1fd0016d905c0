"""The order of poses: short in joint space, every move checked for collisions."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import frozen

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.arrays import Floats, Ints

# A move is checked this often: a tip 1 m away goes 2 cm between, half of what its clearance leaves. [rad or m]
_STRIDE = 0.02
# To how many of the nearest poses a way may go on from each.
_NEIGHBOURS = 10


@dataclass(frozen=True, eq=False)
class Route:
    """A way through poses.

    Attributes:
        q: (K, n) joint values along it. [rad or m]
        pose: (K,) which pose each is; -1 where the arm only passes.
        unreached: poses that no free way was found to.
    """

    q: Floats
    pose: Ints
    unreached: tuple[int, ...]


NOWHERE = Route(np.zeros((0, 0)), np.zeros(0, np.intp), ())
"""The way through no pose."""


class Moves:
    """Straight moves in joint space, each checked once."""

    def __init__(self, is_free: Callable[[Floats], bool] | None, touches_not: Callable[[Floats], bool] | None) -> None:
        """Take what tells whether the arm keeps clear, and whether at least it collides with nothing.

        None where that is not known. A move from where the arm is not clear need but collide with nothing.
        """
        self._is_free, self._touches_not = is_free, touches_not
        self._known: dict[tuple[bytes, bytes], bool] = {}

    def clear(self, q: Floats) -> bool:
        """Return whether the arm keeps clear of everything at ``q`` (n,)."""
        return self._is_free is None or self._is_free(q)

    def free(self, a: Floats, b: Floats) -> bool:
        """Return whether the arm can move from ``a`` (n,) straight to ``b`` (n,)."""
        if self._is_free is None or self._touches_not is None:
            return True
        ends = sorted((a.tobytes(), b.tobytes()))
        key = ends[0], ends[1]
        if key not in self._known:
            steps = np.linspace(0.0, 1.0, 2 + int(np.abs(b - a).max() / _STRIDE))[1:-1]
            # Where it collides is more often the middle than the ends, which are free.
            steps = steps[np.argsort(np.abs(steps - 0.5), kind="stable")]
            free = self._is_free if self._is_free(a) and self._is_free(b) else self._touches_not
            self._known[key] = all(free(a + step * (b - a)) for step in steps)
        return self._known[key]


class Roadmap:
    """Poses, and straight moves between those near each other, which are checked when a way is to lead over them."""

    def __init__(self, points: Floats, moves: Moves) -> None:
        """Connect points (N, n) with their neighbours."""
        self._points, self._moves = points, moves
        distance = distances(points)
        near = np.argsort(distance, axis=1)[:, 1 : 1 + _NEIGHBOURS]
        # What is no neighbour has no move: infinite.
        self._length = np.full(distance.shape, np.inf)
        rows = np.arange(len(points))[:, None]
        self._length[rows, near] = self._length[near, rows] = distance[rows, near]

    def way(self, a: int, b: int) -> list[int] | None:
        """Return the points between ``a`` and ``b`` on a short way that is free; None where there is none."""
        from scipy.sparse.csgraph import dijkstra

        if self._moves.free(self._points[a], self._points[b]):
            return []
        while True:
            _, before = dijkstra(self._length, indices=a, return_predecessors=True)
            if before[b] < 0:
                return None
            way = [b]
            while way[-1] != a:
                way.append(int(before[way[-1]]))
            way.reverse()
            blocked = [
                ends for ends in pairwise(way) if not self._moves.free(self._points[ends[0]], self._points[ends[1]])
            ]
            if not blocked:
                return way[1:-1]
            for i, k in blocked:
                self._length[i, k] = self._length[k, i] = np.inf


def route(
    q: Floats, start: Floats | None, moves: Moves, vias: Floats, progress: Callable[[float], object] | None = None
) -> Route:
    """Find a short way through poses: to the nearest, then 2-opt; around what is in the way over other poses.

    Args:
        q: (N, n) the poses, each free. [rad or m]
        start: (n,) where the arm is; None where that is not known: the way then begins at the first one.
        moves: that are free.
        vias: (M, n) free poses to go around by. [rad or m]
        progress: called with the number of poses reached since the last call.
    """
    points = q if start is None else np.vstack([start, q])
    first = 0 if start is None else 1
    order = _two_opt(_nearest(distances(points)), distances(points))
    every = np.vstack([points, vias])
    roadmap = Roadmap(every, moves)
    way, pose, unreached, last = [points[0]], [-first], [], 0
    for k in order[1:]:
        between = roadmap.way(last, k)
        if between is None:
            unreached.append(k - first)
        else:
            way += [*every[between], points[k]]
            pose += [*[-1] * len(between), k - first]
            last = k
        if progress is not None:
            progress(1)
    return Route(frozen(way)[first:], frozen(pose, np.intp)[first:], tuple(unreached))


def distances(points: Floats) -> Floats:
    """Return how far the joint that moves most moves between points (N, n), (N, N). [rad or m]."""
    result: Floats = np.abs(points[:, None] - points).max(axis=2)
    return result


def length(order: Sequence[int], distance: Floats) -> float:
    """Return the length of a way. [rad or m]."""
    return float(distance[list(order[:-1]), list(order[1:])].sum())


def _nearest(distance: Floats) -> list[int]:
    order, left = [0], set(range(1, len(distance)))
    while left:
        order.append(min(left, key=lambda k: float(distance[order[-1], k])))
        left.remove(order[-1])
    return order


def _two_opt(order: list[int], distance: Floats) -> list[int]:
    """Turn parts of the way around while that makes it shorter; its first point stays."""
    shorter = True
    while shorter:
        shorter = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                a, b, c = order[i - 1], order[i], order[j]
                gain = distance[a, b] - distance[a, c]
                if j + 1 < len(order):
                    gain += distance[c, order[j + 1]] - distance[b, order[j + 1]]
                if gain > 1e-9:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    shorter = True
    return order
