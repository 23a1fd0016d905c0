"""How the arm moved while it was measured: at rest in every pose, or filmed in motion, with a log of joint values."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, frozen, keep
from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from scipy.interpolate import BSpline, CubicSpline

# Readings farther apart than this are not joined by a curve. A cubic is off by 5/384 h^4 of the fourth derivative: with
# a joint that swings at 0.5 rad/s every four seconds by 1e-5 rad at 0.15 s, and 2e-3 rad at 0.5 s.
LONGEST_GAP = 0.15
# Readings that would need more are none: a stamp repeated but for rounding, a value that is no angle. [rad/s or m/s]
_FASTEST = 1e9
# What the arm does within an image is told from a cubic spline with a knot every so often, a dozen readings at 125 Hz;
# joints that ramp up within a second are met by it to 1e-5 rad. [s]
_KNOTS = 0.1
# Fewer readings are no dozen at all.
_FEWEST = 8
# Frames this near to where the log has nothing are left out: an offset of tens of milliseconds must not carry them
# there, and a spline's last pieces are its worst. [s]
MARGIN = 0.1


# Configurations that differ by less in every joint repeat each other: the errors of geometry, sag and joint readings,
# which change over radians, are the same there, and only the measurement's own noise is drawn anew. [rad or m]
REPEAT = 0.05


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
    def read_otherwise(self, change: Callable[[Floats], Floats]) -> Motion:
        """Return the motion with other joint readings.

        Args:
            change: returns other joint values for those (K, n) that the arm's log has.
        """

    @abstractmethod
    def covered(self, count: int, time_offsets: Floats) -> Bools:
        """Return for which of ``count`` poses there are joint readings with the cameras' time offsets (C,) in s."""

    @abstractmethod
    def independent(self, q: Floats) -> Ints:
        """Number the stretches or configurations (N,) whose errors are independent: what a bootstrap may resample.

        Args:
            q: (N, n) joint values as read. [rad or m]
        """

    @abstractmethod
    def folds(self, q: Floats, folds: int, seed: int) -> Ints:
        """Divide the poses of joint values (N, n) into folds (N,) for cross-validation; no unit is divided."""


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

    def read_otherwise(self, change: Callable[[Floats], Floats]) -> AtRest:
        """Return the same: an arm at rest has no log."""
        return self

    def covered(self, count: int, time_offsets: Floats) -> Bools:
        """Return that all poses have readings."""
        return np.ones(count, dtype=bool)

    def independent(self, q: Floats) -> Ints:
        """Number the configurations: repeats of one, and those next to it, have its errors."""
        number = np.full(len(q), -1, dtype=np.intp)
        count = 0
        for pose, near in enumerate(_neighbours(q)):
            if number[pose] < 0:
                number[[other for other in near if number[other] < 0]] = count
                count += 1
        return number

    def folds(self, q: Floats, folds: int, seed: int) -> Ints:
        """Divide the configurations at random."""
        unit = self.independent(q)
        count = int(unit.max()) + 1
        fold = np.empty(count, dtype=np.intp)
        fold[np.random.default_rng(seed).permutation(count)] = np.arange(count) % folds
        result: Ints = fold[unit]
        return result


def _neighbours(q: Floats) -> Sequence[Sequence[int]]:
    """For each of the joint values (N, n) those that repeat it."""
    from scipy.spatial import KDTree

    return KDTree(q).query_ball_point(q, REPEAT, p=np.inf, return_sorted=True)  # type: ignore[no-any-return]


AT_REST = AtRest()
"""The motion of an arm that stood still in every pose."""


@dataclass(frozen=True, eq=False)
class JointLog:
    """Joint values over time: a cubic spline through readings (not-a-knot at its ends).

    It goes through the readings as they are. Of a joint that swings at 0.5 rad/s it is off by 4e-8 rad rms at 20 Hz, a
    Hermite curve through differences by 2e-6; with readings to 2e-5 rad both are off by these, and their velocities
    by less than 1 % at 125 Hz.

    Attributes:
        time: (K,) strictly increasing, on the robot's clock. [s]
        values: (K, n) of all joints of the chain, continuous ones without jumps of a turn. [rad or m]
    """

    time: Floats
    values: Floats

    def __post_init__(self) -> None:
        keep(self, time=frozen(self.time), values=frozen(self.values))
        if self.time.ndim != 1 or len(self.time) < 2 or self.values.shape[:1] != self.time.shape:
            raise SessionError(
                f"a log of joint values has times {self.time.shape} and values {self.values.shape}", where="session"
            )
        if not (np.isfinite(self.time).all() and np.isfinite(self.values).all()):
            raise SessionError("a log of joint values is not finite", where="session")
        if np.diff(self.time).min() <= 0.0:
            raise SessionError("the times of the joint values do not increase", where="session")
        with np.errstate(over="ignore", divide="ignore"):
            speed = np.abs(np.diff(self.values, axis=0) / np.diff(self.time)[:, None])
        if speed.max() > _FASTEST:
            what = f"a joint moves at {speed.max():.2g} rad/s or m/s between two readings"
            raise SessionError(what, where="session", remedy="Check the times and the values of the joint readings.")

    @cached_property
    def _spline(self) -> CubicSpline:
        from scipy.interpolate import CubicSpline

        return CubicSpline(self.time, self.values)

    def at(self, time: Floats) -> Floats:
        """Joint values (N, n) at times (N,) on the robot's clock; those of its end where it has none. [rad or m]."""
        values: Floats = self._spline(np.clip(time, self.time[0], self.time[-1]))
        return values

    def velocities(self, time: Floats) -> Floats:
        """The derivative (N, n) of :meth:`at`. [rad/s or m/s]."""
        inside = (time >= self.time[0]) & (time <= self.time[-1])
        values: Floats = np.where(inside[:, None], self._spline(np.clip(time, self.time[0], self.time[-1]), 1), 0.0)
        return values

    @cached_property
    def _smooth(self) -> BSpline:
        from scipy.interpolate import make_interp_spline, make_lsq_spline

        if len(self.time) < _FEWEST:
            return make_interp_spline(self.time, self.values, k=min(3, len(self.time) - 1))
        every = max(1, round(_KNOTS / float(np.median(np.diff(self.time)))))
        knots = self.time[2 * every : -2 * every : every]
        ends = np.repeat(self.time[[0, -1]], 4)
        return make_lsq_spline(self.time, self.values, np.concatenate([ends[:4], knots, ends[4:]]), k=3)

    def later(self, time: Floats, late: Floats) -> tuple[Floats, Floats, Floats]:
        """What follows on times (N,) by ``late`` (N,), at most some tens of milliseconds. [s].

        The noise of the readings at a time is the same a little later, and their differences are none of the arm's: by
        a curve through the readings, an encoder of 0.4 mrad at 125 Hz would have the arm move at 0.08 rad/s more or
        less, and what is estimated from how it moves would be a fifth too small.

        Returns:
            Joint values (N, n) in rad or m, and their derivatives (N, n) by both times.
        """
        first, last = self.time[0], self.time[-1]
        before, after = np.clip(time, first, last), np.clip(time + late, first, last)
        smooth, slope = self._smooth, self._smooth.derivative()
        values = self.at(time) + smooth(after) - smooth(before)
        return values, self.velocities(time) + slope(after) - slope(before), slope(after)

    def covers(self, time: Floats) -> Bools:
        """Which times (N,) are well within the log, away from its ends and its gaps."""
        first, last = time - MARGIN, time + MARGIN
        gaps = np.concatenate([[0], np.cumsum(np.diff(self.time) > LONGEST_GAP)])
        before = np.clip(np.searchsorted(self.time, first, side="right") - 1, 0, None)
        after = np.clip(np.searchsorted(self.time, last, side="left"), None, len(self.time) - 1)
        inside = (first >= self.time[0]) & (last <= self.time[-1])
        return np.asarray(inside & (gaps[after] == gaps[before]))


@dataclass(frozen=True, eq=False)
class Trajectory(Motion):
    """The frames of a moving arm: each is a pose of its own, seen by one camera.

    Attributes:
        log: the arm's motion.
        frames: of each camera, the labels of all frames that it took, in order.
        camera: (N,) of the frames that are used, the camera.
        row: (N,) which of its frames.
        time: (N,) when, on the camera's clock. [s]
        line: (N,) of a rolling shutter, how far below the middle of the image what was seen is; empty of others, which
            take all rows at once. [px]
    """

    log: JointLog
    frames: tuple[tuple[str, ...], ...]
    camera: Ints
    row: Ints
    time: Floats
    line: Floats = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        keep(self, camera=frozen(self.camera, np.intp), row=frozen(self.row, np.intp), time=frozen(self.time))
        keep(self, line=frozen(self.line))
        if not len(self.camera) == len(self.row) == len(self.time) == (len(self.line) or len(self.time)):
            raise SessionError("the frames' cameras, rows and times differ in number", where="trajectory")

    def at(self, poses: Ints) -> Trajectory:
        """Return the same of some of the frames, (K,) indices."""
        line = self.line[poses] if len(self.line) else self.line
        return replace(self, camera=self.camera[poses], row=self.row[poses], time=self.time[poses], line=line)

    def label(self, pose: int, labels: Sequence[str] = ()) -> str:
        """Return what its camera calls a frame."""
        return self.frames[int(self.camera[pose])][int(self.row[pose])]

    def robot_time(self, time_offsets: Floats) -> Floats:
        """Return when (N,) the middle rows of the frames were taken, on the robot's clock, for offsets (C,). [s]."""
        result: Floats = self.time + time_offsets[self.camera]
        return result

    def values(self, time_offsets: Floats) -> Floats:
        """Return the joint values (N, n) when what is seen in the frames was taken. [rad or m].

        Args:
            time_offsets: (C,) of the cameras' clocks in s, or (2 C,) followed by their line times in s.
        """
        late = self._late(time_offsets)
        time = self.robot_time(time_offsets)
        return self.log.at(time) if late is None else self.log.later(time, late)[0]

    def velocities(self, time_offsets: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives (N, n) of :meth:`values` by the offset and by the line time of the frame's camera."""
        late, time = self._late(time_offsets), self.robot_time(time_offsets)
        if late is None:
            by_offset = self.log.velocities(time)
            return by_offset, np.zeros_like(by_offset)
        _, by_offset, by_lateness = self.log.later(time, late)
        return by_offset, by_lateness * self.line[:, None]

    def _late(self, time_offsets: Floats) -> Floats | None:
        """How long (N,) after the middle row what is seen was taken; None where all rows are taken at once. [s]."""
        if not len(self.line) or len(time_offsets) == len(self.frames):
            return None
        result: Floats = time_offsets[len(self.frames) + self.camera] * self.line
        return result

    def joint_values(self, q: Floats, time_offsets: Floats) -> Floats:
        """Return what the log says: ``q`` is what it said with other offsets."""
        return self.values(time_offsets)

    def read_otherwise(self, change: Callable[[Floats], Floats]) -> Trajectory:
        """Return the same frames of a log with other joint values."""
        return replace(self, log=replace(self.log, values=change(self.log.values)))

    def covered(self, count: int, time_offsets: Floats) -> Bools:
        """Return which frames are well within the log."""
        return self.log.covers(self.robot_time(time_offsets))

    def independent(self, q: Floats) -> Ints:
        """Number the seconds: the errors of neighbouring frames are alike."""
        result: Ints = np.floor(self.time - self.time.min()).astype(np.intp)
        return result

    def folds(self, q: Floats, folds: int, seed: int) -> Ints:
        """Divide the frames into stretches of time: to predict one from its neighbours would be no test."""
        fold = np.empty(len(q), dtype=np.intp)
        fold[np.argsort(self.time, kind="stable")] = np.arange(len(q)) * folds // len(q)
        return fold
