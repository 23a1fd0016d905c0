"""Sightings arranged pose by pose, padded to the same number a pose, so that whole arrays can be evaluated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, evenly, frozen

if TYPE_CHECKING:
    from urdfcal.session.attachments import Frames
    from urdfcal.session.model import Session
    from urdfcal.session.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Observations:
    """All sightings of one kind: pixels (D = 2) or points (D = 3).

    N poses have sightings, at most m each; slots beyond a pose's own number are padding.

    Attributes:
        pose: (N,) index into the session's poses.
        q: (N, n) joint values. [rad or m]
        row: (N, m) row of the session's table; -1 for padding.
        led: (N, m) LED index.
        camera: (N, m) camera index; -1 for points, which are given in the world frame.
        value: (N, m, D) pixels, or metres.
        covariance: (N, m, D, D) of the measurement alone; identity for padding.
        frames: what the LEDs and the cameras are fastened to.
        trajectory: of an arm that moved: the N frames, whose joint values depend on the cameras' time offsets.
    """

    pose: Ints
    q: Floats
    row: Ints
    led: Ints
    camera: Ints
    value: Floats
    covariance: Floats
    frames: Frames
    trajectory: Trajectory | None = None

    def joints(self, time_offsets: Floats) -> Floats:
        """(N, n) joint values under the cameras' time offsets (C,) in s. [rad or m]."""
        return self.q if self.trajectory is None else self.trajectory.values(time_offsets)

    def spread(self, most: int) -> Ints:
        """Indices of poses spread evenly over what each camera saw of each LED, at most so many of each."""
        views = np.where(self.valid, (self.camera + 1) * (1 + self.led.max(initial=0)) + self.led, -1)
        chosen = []
        for one in np.unique(views[self.valid]):
            chosen.append(evenly(np.flatnonzero((views == one).any(axis=1)), most))
        return np.unique(np.concatenate(chosen))

    def at(self, poses: slice | Bools | Ints) -> Observations:
        """The observations of some of the poses."""
        trajectory = None if self.trajectory is None else self.trajectory.at(np.arange(len(self.pose))[poses])
        arrays = ("pose", "q", "row", "led", "camera", "value", "covariance")
        return replace(self, **{name: getattr(self, name)[poses] for name in arrays}, trajectory=trajectory)

    @property
    def dimension(self) -> int:
        """D: 2 for pixels, 3 for points."""
        return int(self.value.shape[-1])

    @property
    def valid(self) -> Bools:
        """(N, m) whether a slot holds a sighting."""
        return self.row >= 0

    @property
    def led_frame(self) -> Ints:
        """(N, m) the frame that each LED is fixed in."""
        return self.frames.led[self.led]

    @property
    def view_frame(self) -> Ints:
        """(N, m) the frame that each camera is fixed in; for points the world."""
        if self.dimension == 3:
            return np.zeros_like(self.camera)
        return self.frames.camera[self.camera]

    @property
    def count(self) -> int:
        """Number of sightings."""
        return int(np.count_nonzero(self.valid))

    def by_row(self, slots: Floats) -> Floats:
        """Bring per-slot values (N, m, ...) into the order of the session's table, (S, ...)."""
        result = np.zeros((self.count, *slots.shape[2:]), dtype=slots.dtype)
        result[self.row[self.valid]] = slots[self.valid]
        return result


def arrange(
    q: Floats, pose: Ints, led: Ints, camera: Ints, value: Floats, covariance: Floats, frames: Frames
) -> Observations:
    """Group S sightings by pose.

    Args:
        q: (poses, n) joint values of all poses.
        pose: (S,) pose of each sighting.
        led: (S,) LED of each.
        camera: (S,) camera of each, -1 for points.
        value: (S, D) what was measured.
        covariance: (S, D, D) how well.
        frames: what LEDs and cameras are fastened to.
    """
    order = np.argsort(pose, kind="stable")
    poses, counts = np.unique(pose, return_counts=True)
    group = np.repeat(np.arange(len(poses)), counts)
    slot = np.arange(len(pose)) - np.repeat(np.cumsum(counts) - counts, counts)
    shape = (len(poses), int(counts.max(initial=0)))
    dimension = value.shape[1]
    row = np.full(shape, -1, dtype=np.intp)
    leds, cameras = np.zeros(shape, dtype=np.intp), np.full(shape, -1, dtype=np.intp)
    values = np.zeros((*shape, dimension))
    covariances = np.broadcast_to(np.eye(dimension), (*shape, dimension, dimension)).copy()
    row[group, slot] = order
    leds[group, slot], cameras[group, slot] = led[order], camera[order]
    values[group, slot], covariances[group, slot] = value[order], covariance[order]
    return Observations(
        pose=frozen(poses, np.intp),
        q=frozen(q[poses]),
        row=frozen(row, np.intp),
        led=frozen(leds, np.intp),
        camera=frozen(cameras, np.intp),
        value=frozen(values),
        covariance=frozen(covariances),
        frames=frames,
    )


def observe(session: Session) -> tuple[Observations, ...]:
    """Arrange a session's detections and points, each kind that is there."""
    blocks = []
    if session.detections is not None:
        d = session.detections
        block = arrange(session.q, d.pose, d.led, d.camera, d.uv, _isotropic(d.sigma, 2), session.frames)
        if session.trajectory is not None:
            block = replace(block, trajectory=session.trajectory.at(block.pose))
        blocks.append(block)
    if session.points is not None:
        p = session.points
        nowhere = np.full_like(p.led, -1)
        blocks.append(arrange(session.q, p.pose, p.led, nowhere, p.xyz, _isotropic(p.sigma, 3), session.frames))
    return tuple(blocks)


def _isotropic(sigma: Floats, dimension: int) -> Floats:
    return sigma[:, None, None] ** 2 * np.eye(dimension)
