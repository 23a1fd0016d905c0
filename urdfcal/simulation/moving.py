"""An arm that moves past its cameras: where it is, and what they see, when each row of each frame is taken."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.simulation.joint_errors import true_joint_values

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.session.model import Positions
    from urdfcal.simulation.truth import Truth

# From rest to full speed, and back: at 0.5 rad/s by up to 0.75 rad/s^2, half of what a UR's movej takes unasked. [s]
_RAMP = 1.0
REST = 0.5
"""The joints' log begins this long before the arm moves and ends this long after. [s]"""
# After which the row that an LED is in is known to 1e-4 px.
_STEPS = 3
# Rows between which poses are interpolated: within 2 ms an arm's pose bends by 3e-6 rad.
_KNOTS = 9


@dataclass(frozen=True, eq=False)
class JointPath:
    """Legs between poses, each from rest to rest: times (L + 1,) at the poses (L + 1, n)."""

    times: Floats
    poses: Floats

    @classmethod
    def through(cls, poses: Floats, speed: float) -> JointPath:
        """Move at a speed [rad/s or m/s] of the fastest joint."""
        cruise = np.abs(np.diff(poses, axis=0)).max(axis=1) / speed
        # Of a leg too short for full speed the ramps are shorter, and no steeper.
        ramp = np.minimum(_RAMP, np.sqrt(_RAMP * cruise))
        return cls(REST + np.concatenate([[0.0], np.cumsum(ramp + np.maximum(cruise, ramp))]), poses)

    @property
    def end(self) -> float:
        """When it is at the last. [s]."""
        return float(self.times[-1])

    def at(self, time: Floats) -> Floats:
        """Return the joint values (N, n) at times (N,)."""
        leg = np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2)
        duration = self.times[leg + 1] - self.times[leg]
        since, ramp = np.clip(time - self.times[leg], 0.0, duration), np.minimum(_RAMP, duration / 2.0)
        cruised = np.clip(since, ramp, duration - ramp) - ramp
        ramped = ramp * (0.5 + _ramped(since / ramp) - _ramped((duration - since) / ramp))
        way = (ramped + cruised) / (duration - ramp)
        result: Floats = self.poses[leg] + way[:, None] * (self.poses[leg + 1] - self.poses[leg])
        return result


def _ramped(part: Floats) -> Floats:
    """Integrate the speed up to a part (N,) of a ramp: it rises as 3 part^2 - 2 part^3, with no jump in its slope."""
    part = np.minimum(part, 1.0)
    result: Floats = part**3 * (1.0 - part / 2.0)
    return result


@dataclass(frozen=True, eq=False)
class Moving:
    """How an arm moved.

    Attributes:
        path: of its joints, as perfect encoders say.
        positions: of the N frames, without noise.
        time: (N,) at which each frame's middle row was taken, by the robot's clock. [s]
        camera: (N,) that took it.
    """

    path: JointPath
    positions: Positions
    time: Floats
    camera: Ints

    def later(self, truth: Truth, late: Floats | float) -> Floats:
        """Return the true joint values (N, n) so much (N,) later than each frame. [rad or m]."""
        return true_joint_values(replace(self.positions, q=self.path.at(self.time + late)), truth.joint_errors)


def pixels_as_taken(truth: Truth) -> Floats:
    """Compute where (N, C, L + M, 2) cameras see LEDs and points, of rolling shutters each in its row. [px]."""
    pixels: Floats = truth.pixels(truth.q)
    if truth.rolling is not None:
        pixels[np.arange(len(pixels)), truth.rolling.camera] = pixels_by_row(truth, truth.rolling)
    return pixels


def pixels_by_row(truth: Truth, moving: Moving) -> Floats:
    """Compute where (N, L + M, 2) each frame's camera sees LEDs and points that are in a row when it is taken. [px]."""
    each, line, middle = _frames(truth, moving)

    def seen(late: Floats | float) -> Floats:
        pixels: Floats = truth.pixels(moving.later(truth, late))[each, moving.camera]
        return pixels

    uv = seen(0.0)
    # An LED at 1,000 px/s moves 1e-3 of the rows that pass meanwhile: each step wins two digits.
    for _ in range(_STEPS):
        for led in range(uv.shape[1]):
            uv[:, led] = seen(line * np.nan_to_num(uv[:, led, 1] - middle))[:, led]
    return uv


@dataclass(frozen=True, eq=False)
class PosesByRow:
    """T_cam_target (K, N, T, 4, 4) of each frame's camera at K rows (K, N) of its image. [m]."""

    rows: Floats
    T_cam_target: Floats

    @classmethod
    def of(cls, truth: Truth, moving: Moving) -> PosesByRow:
        """Compute them where rows are taken one after the other."""
        each, line, middle = _frames(truth, moving)
        rows = np.linspace(0.0, 2.0 * middle, _KNOTS)
        poses = [truth.target_poses(moving.later(truth, line * (row - middle)))[each, moving.camera] for row in rows]
        return cls(rows, np.array(poses))

    def at(self, frame: int, target: int, height: int) -> Floats:
        """Return T_cam_target (height, 4, 4) of every row of a frame."""
        rows, T = self.rows[:, frame], self.T_cam_target[:, frame, target]
        place = np.interp(np.arange(height), rows, np.arange(len(rows), dtype=float))
        before = np.minimum(place.astype(np.intp), len(rows) - 2)
        share = (place - before)[:, None, None]
        result: Floats = (1.0 - share) * T[before] + share * T[before + 1]
        return result


def _frames(truth: Truth, moving: Moving) -> tuple[Ints, Floats, Floats]:
    """Numbers of the frames (N,), and of the camera that took each its line time [s] and its middle row [px]."""
    line = np.array([camera.line_time for camera in truth.cameras])
    middle = np.array([(camera.resolution[1] - 1) / 2.0 for camera in truth.cameras])
    return np.arange(len(moving.time)), line[moving.camera], middle[moving.camera]
