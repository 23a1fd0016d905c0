"""Measurements arranged pose by pose, padded to the same number a pose, so that whole arrays can be evaluated."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, evenly, frozen, numbered
from urdfcal.estimation.joint_models import Readings
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.estimation.measurements import Measurement
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False)
class Observations:
    """All measurements of one kind, of D numbers each.

    N poses have measurements, at most m each; slots beyond a pose's own number are padding.

    Attributes:
        table: the measurements, and how they are predicted.
        readings: of the joints at the N poses.
        row: (N, m) row of the table; -1 for padding.
        index: for each key of the table but the pose (N, m) indices; 0 for padding.
        value: (N, m, D) what was measured; 0 for padding. [unit of the table]
        covariance: (N, m, D, D) of the measurement alone; identity for padding.
        line: (N, m) of a moving arm before a rolling shutter, how far below the middle of its image each is seen, which
            is then taken at a time of its own; empty of others. [px]
    """

    table: Measurement
    readings: Readings
    row: Ints
    index: Mapping[str, Ints]
    value: Floats
    covariance: Floats
    line: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    @cached_property
    def by_slot(self) -> Observations:
        """The same with a pose for each slot (N m, 1) where slots are taken at times of their own; else the same."""
        motion = self.readings.motion
        if not self.line.size or not isinstance(motion, Trajectory):
            return self
        each = np.repeat(np.arange(len(self.row)), self.row.shape[1])
        readings = self.readings.at(each)
        readings = replace(readings, motion=replace(motion.at(each), line=self.line.ravel()))
        single = {key: column.reshape(-1, 1) for key, column in self.index.items()}
        value, covariance = (of.reshape(-1, 1, *of.shape[2:]) for of in (self.value, self.covariance))
        return Observations(self.table, readings, self.row.reshape(-1, 1), single, value, covariance)

    @property
    def pose(self) -> Ints:
        """(N,) index into the session's poses."""
        return self.readings.pose

    @property
    def valid(self) -> Bools:
        """(N, m) whether a slot holds a measurement."""
        return self.row >= 0

    @property
    def dimension(self) -> int:
        """D, the numbers of one measurement."""
        return int(self.value.shape[-1])

    @property
    def count(self) -> int:
        """Number of measurements."""
        return int(np.count_nonzero(self.valid))

    def at(self, poses: slice | Bools | Ints) -> Observations:
        """Return the observations of some of the poses."""
        return Observations(
            self.table,
            self.readings.at(poses),
            self.row[poses],
            {key: column[poses] for key, column in self.index.items()},
            self.value[poses],
            self.covariance[poses],
            self.line[poses] if self.line.size else self.line,
        )

    def even(self, most: int) -> Ints:
        """Return indices of poses, at most so many, spread evenly over all."""
        return evenly(np.arange(len(self.pose)), most)

    def spread(self, most: int) -> Ints:
        """Return indices of poses, at most so many for each combination of keys (LED, camera), spread evenly."""
        views = np.where(self.valid, numbered(self.index.values()), -1)
        chosen = [evenly(np.flatnonzero((views == one).any(axis=1)), most) for one in np.unique(views[self.valid])]
        return np.unique(np.concatenate(chosen))

    def by_row(self, slots: Floats) -> Floats:
        """Bring per-slot values (N, m, ...) into the order of the table, (S, ...)."""
        result = np.zeros((self.count, *slots.shape[2:]), dtype=slots.dtype)
        result[self.row[self.valid]] = slots[self.valid]
        return result


def arrange(session: Session, table: Measurement) -> Observations:
    """Group the measurements of a table by pose."""
    poses, counts = np.unique(table.pose, return_counts=True)
    group = np.repeat(np.arange(len(poses)), counts)  # tables are sorted by pose
    slot = np.arange(len(table)) - np.repeat(np.cumsum(counts) - counts, counts)
    shape, D = (len(poses), int(counts.max())), table.dimension
    row = np.full(shape, -1, dtype=np.intp)
    row[group, slot] = np.arange(len(table))
    index = {}
    for key, column in table.index.items():
        if key != "pose":
            padded = np.zeros(shape, dtype=np.intp)
            padded[group, slot] = column
            index[key] = frozen(padded, np.intp)
    value = np.zeros((*shape, D))
    covariance = np.broadcast_to(np.eye(D), (*shape, D, D)).copy()
    value[group, slot], covariance[group, slot] = table.compared, table.covariances
    readings = Readings.of(session).at(poses)
    cameras, line = session.rig.cameras, np.zeros((0, 0))
    if isinstance(session.motion, Trajectory) and any(camera.rolling for camera in cameras):
        middle = np.array([(camera.resolution[1] - 1) / 2.0 for camera in cameras])
        line = np.where(row >= 0, value[..., 1] - middle[index["camera"]], 0.0)
    return Observations(table, readings, frozen(row, np.intp), index, frozen(value), frozen(covariance), frozen(line))
