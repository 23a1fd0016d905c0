"""Where an arm stood still while it was recorded, and how well its joints were read there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, Ints, frozen
from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from urdfcal.rosbag.clock import Timeline

_NANO = 1e9
# An arm is still as long as no joint changes by more than this within a window: it creeps at 3 mrad/s or 3 mm/s at most
# where its encoders are fine; those of hobby servos, 1.5 mrad a step, flicker between two values. [s, rad or m, steps]
_WINDOW, _STILL, _STEPS = 0.3, 1e-3, 1.5
# Over a whole stretch, however long, it may go this many times as far.
_CREEP = 2.0
# Shorter stops are those of a path's corners; frames are taken 10 to 100 ms before or after their stamps. [s]
_SHORTEST, _SETTLED = 0.5, 0.15
# Smaller differences are those of doubles. Of numbers that are no multiples, one in ten is as near to one as this.
_ROUNDING, _WHOLE, _MOSTLY = 1e-9, 0.05, 0.8
_FEWEST = 3


@dataclass(frozen=True, eq=False)
class Stills:
    """The stretches in which an arm stood still.

    Attributes:
        start: (P,) of each, when the arm had settled. [ns]
        end: (P,) of each. [ns]
        readings: (P, k) mean joint readings. [rad or m]
        sigma: how well those are known by what the readings scatter, of all joints alike; 0 where nothing shows it.
            [rad or m]
        creeping: number of further stretches, in which it crept on.
    """

    start: Ints
    end: Ints
    readings: Floats
    sigma: float
    creeping: int

    def __post_init__(self) -> None:
        for name, kind in (("start", np.int64), ("end", np.int64), ("readings", np.float64)):
            object.__setattr__(self, name, frozen(getattr(self, name), kind))

    def __len__(self) -> int:
        return len(self.start)

    def nearest(self, times: Timeline) -> dict[int, int]:
        """Choose of a camera's images for each still the one nearest its middle.

        Args:
            times: when they were taken, on the robot's clock.

        Returns:
            The number of the message, from 1, by the index of the still; none where there is no image.
        """
        chosen = {}
        for k, (start, end) in enumerate(zip(self.start.tolist(), self.end.tolist(), strict=True)):
            first, last = np.searchsorted(times.time, [start, end])
            if last > first:
                middle = first + int(np.argmin(np.abs(times.time[first:last] - (start + end) // 2)))
                chosen[k] = int(times.kept[middle]) + 1
        return chosen


def find_stills(times: Timeline, readings: Floats) -> Stills:
    """Find where an arm stood still.

    Args:
        times: of the joint readings.
        readings: (K, k) of all joints. [rad or m]

    Raises:
        SessionError: it did so less than three times.
    """
    t = times.time.astype(np.float64) / _NANO
    t -= t[0]
    step = _steps(readings)
    allowed = np.maximum(_STILL, _STEPS * step)
    # Of each reading, how far the joints go in the window that begins with it.
    last = np.searchsorted(t, t + _WINDOW)
    still = np.zeros(len(t), dtype=bool)
    for i, j in enumerate(last.tolist()):
        if j < len(t) and t[j] - t[i] < 2.0 * _WINDOW:
            still[i] = bool((np.ptp(readings[i : j + 1], axis=0) < allowed).all())
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.view(np.int8), [0]])))
    stretches: list[list[int]] = []
    for first, end in edges.reshape(-1, 2).tolist():
        stop = int(last[end - 1])
        before = stretches[-1][1] if stretches else -np.inf
        # A single reading that flickers ends no stretch.
        if first <= before + 2 and (np.abs(readings[first] - readings[stretches[-1][1]]) < allowed).all():
            stretches[-1][1] = stop
        else:
            stretches.append([first, stop])
    long = [(a, b) for a, b in stretches if t[b] - t[a] >= _SHORTEST + 2.0 * _SETTLED]
    rows = [slice(*np.searchsorted(t, [t[a] + _SETTLED, t[b] - _SETTLED]).tolist()) for a, b in long]
    kept = [row for row in rows if (np.ptp(readings[row], axis=0) < _CREEP * allowed).all()]
    if len(kept) < _FEWEST:
        least = _SHORTEST + 2.0 * _SETTLED
        raise SessionError(
            f"the arm stood still for {least:g} s or longer {len(kept)} times: these are too few poses",
            where=times.topic,
            remedy="Leave --stills out: a moving arm is calibrated as well.",
        )
    means = np.array([readings[row].mean(axis=0) for row in kept])
    starts, ends = times.time[[row.start for row in kept]], times.time[[row.stop - 1 for row in kept]]
    return Stills(starts, ends, means, _scatter([readings[row] for row in kept], step), len(rows) - len(kept))


def _steps(readings: Floats) -> Floats:
    """(k,) the step by which each joint's readings are rounded; 0 where differences are no multiples of one."""
    steps = np.zeros(readings.shape[1])
    for k, moves in enumerate(np.abs(np.diff(readings, axis=0)).T):
        moves = moves[moves > _ROUNDING]
        if len(moves):
            multiple = moves / moves.min()
            whole = np.abs(multiple - np.rint(multiple)) < _WHOLE
            steps[k] = moves.min() if whole.mean() > _MOSTLY else 0.0
    return steps


def _scatter(stretches: list[Floats], step: Floats) -> float:
    """How well the means of readings are known: from those of both halves of each stretch, drift included.

    A reading that never changes is rounded: it may be anywhere within a step.
    """
    halves = [(of[: len(of) // 2].mean(axis=0), of[len(of) // 2 :].mean(axis=0)) for of in stretches if len(of) > 1]
    differences = np.array([second - first for first, second in halves]).reshape(-1, len(step))
    by_halves = np.sqrt(np.mean(differences**2, axis=0)) / 2.0
    return float(np.sqrt(np.mean(np.maximum(by_halves, step / np.sqrt(12.0)) ** 2)))
