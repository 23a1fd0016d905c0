"""How the arm moved while it was measured: at rest in every pose, or filmed in motion."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Bools, Floats, Ints


class Motion(ABC):
    """What the N poses of a session are: places where the arm rested, or frames of an arm that moved."""

    @abstractmethod
    def at(self, poses: Ints) -> Motion:
        """Return the motion at some of the poses, (K,) indices."""

    @abstractmethod
    def label(self, pose: int, labels: Sequence[str]) -> str:
        """Return what the tables and the images' file names call a pose of the session's labels."""

    @abstractmethod
    def joint_values(self, q: Floats, time_offsets: Floats) -> Floats:
        """Return joint values (N, n) with the cameras' time offsets (C,) in s. [rad or m].

        Args:
            q: (N, n) joint values as read.
            time_offsets: of the cameras' clocks, t_robot = t_camera + offset.
        """

    @abstractmethod
    def covered(self, count: int, time_offsets: Floats) -> Bools:
        """Return for which of ``count`` poses there are joint readings with the cameras' time offsets (C,) in s."""

    @abstractmethod
    def independent(self, count: int) -> Ints:
        """Number the stretches (count,) whose errors are independent: what a bootstrap may resample."""

    @abstractmethod
    def folds(self, count: int, folds: int, seed: int) -> Ints:
        """Divide ``count`` poses into folds (count,) for cross-validation."""


@dataclass(frozen=True)
class AtRest(Motion):
    """An arm that stood still in every pose."""

    def at(self, poses: Ints) -> AtRest:
        """Return the same."""
        return self

    def label(self, pose: int, labels: Sequence[str]) -> str:
        """Return the pose's own label."""
        return labels[pose]

    def joint_values(self, q: Floats, time_offsets: Floats) -> Floats:
        """Return the readings: clocks do not matter to an arm at rest."""
        return q

    def covered(self, count: int, time_offsets: Floats) -> Bools:
        """Return that all poses have readings."""
        return np.ones(count, dtype=bool)

    def independent(self, count: int) -> Ints:
        """Number the poses: each is on its own."""
        return np.arange(count)

    def folds(self, count: int, folds: int, seed: int) -> Ints:
        """Divide the poses at random."""
        fold = np.empty(count, dtype=np.intp)
        fold[np.random.default_rng(seed).permutation(count)] = np.arange(count) % folds
        return fold


AT_REST = AtRest()
"""The motion of an arm that stood still in every pose."""
