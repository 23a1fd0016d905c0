"""Simulation of a moving arm: through the poses of a simulated session, filmed on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.session.trajectory import JointLog, Trajectory
from urdfcal.simulation.joint_errors import true_joint_values
from urdfcal.simulation.planning import load_collision_checker
from urdfcal.simulation.scene import noisy_values, simulate_detections

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.arrays import Ints
    from urdfcal.cameras.camera import Camera
    from urdfcal.simulation.planning import CollisionChecker
    from urdfcal.simulation.simulate import Simulated

# Keeps the motion's random numbers apart from the session's.
_STREAM = 5
# From rest to full speed, and back: at 0.5 rad/s by up to 0.75 rad/s^2, half of what a UR's movej takes unasked. [s]
_RAMP = 1.0
# The joints' log begins this long before the arm moves and ends this long after; cameras film a little less. [s]
_REST, _DARK = 0.5, 0.25
# A path is checked for collisions this often. [rad or m]
_STRIDE = 0.1
# What the time offsets of cameras are within if nobody says. [s]
_OFFSET = 0.03
# After which the row is known to 1e-4 px.
_STEPS = 3


@dataclass(frozen=True)
class MotionSettings:
    """How the arm is moved and recorded.

    Attributes:
        speed: highest of the fastest joint. [rad/s or m/s]
        frame_rate: of each camera; they are not synchronised. [Hz]
        joint_rate: of the joint readings. [Hz]
        time_offsets: of each camera's clock, t_robot = t_camera + offset; empty draws them within 30 ms. [s]
    """

    speed: float = 0.5
    frame_rate: float = 30.0
    joint_rate: float = 125.0
    time_offsets: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("speed", "frame_rate", "joint_rate"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise SessionError(f"{name} is {getattr(self, name)}, not a positive number", where="simulate")
        if not np.isfinite(self.time_offsets).all():
            raise SessionError(f"time offsets {self.time_offsets} are not all numbers", where="simulate")


def set_in_motion(simulated: Simulated, settings: MotionSettings) -> Simulated:
    """Move the robot of a simulated session through its poses, and film it.

    From pose to pose joints move straight and smoothly, at full speed but for the ramps, resting for a moment at each;
    the order is that of the shortest next path without collisions. Exposure takes no time, and the arm never hides an
    LED on the way. Of a rolling shutter the line time is drawn as it is known; what is seen is where the arm was when
    its row was taken.

    Args:
        simulated: a session of an arm at rest, and its truth.
        settings: how it moves.

    Raises:
        SessionError: there is not one time offset a camera, or no path between the poses.
    """
    session, truth = simulated.session, simulated.truth
    offset_rng, phase_rng, joint_rng, noise_rng, outlier_rng = np.random.default_rng((truth.seed, _STREAM)).spawn(5)
    count, rate = len(truth.cameras), settings.frame_rate
    if settings.time_offsets and len(settings.time_offsets) != count:
        raise SessionError(
            f"{len(settings.time_offsets)} time offsets for {count} cameras", where="simulate", remedy="Name one each."
        )
    time_offsets = np.array(settings.time_offsets or offset_rng.uniform(-_OFFSET, _OFFSET, count))

    checker, _ = load_collision_checker(truth.without_flexures(), session)
    path = _Path.through(_tour(truth.readings, checker), settings.speed)
    log_time = np.arange(0.0, path.end + _REST, 1.0 / settings.joint_rate)
    taken = [np.arange(_DARK + p / rate, path.end + _DARK, 1.0 / rate) for p in phase_rng.random(count)]
    camera = np.repeat(np.arange(count), [len(of) for of in taken])
    time = np.concatenate(taken)
    trajectory = Trajectory(
        log=JointLog(log_time, noisy_values(session, path.at(log_time), joint_rng)),
        frames=tuple(tuple(f"{k:0{len(str(len(of)))}d}" for k in range(1, len(of) + 1)) for of in taken),
        camera=camera,
        row=np.concatenate([np.arange(len(of)) for of in taken]),
        time=time - time_offsets[camera],
    )
    exact = replace(
        session.unmeasured(),
        poses=tuple(f"{truth.cameras[c].name}/{trajectory.label(k)}" for k, c in enumerate(camera.tolist())),
        q=path.at(time),
        time=trajectory.time,
        motion=trajectory,
    )
    q = true_joint_values(exact, truth.joint_errors)
    truth = replace(truth, cameras=tuple(_true_shutter(camera, offset_rng) for camera in truth.cameras))

    def seen(late: Floats) -> Floats:
        """Where (N, L, 2) each LED is seen if everything is taken that much (N,) later than its frame. [px]."""
        later = replace(exact, q=path.at(time + late))
        pixels: Floats = truth.pixels(true_joint_values(later, truth.joint_errors))[np.arange(len(time)), camera]
        return pixels

    uv = _by_rows(truth.cameras, camera, seen) if any(one.rolling for one in truth.cameras) else None
    noise, share = (truth.pixel, session.noise.of(Detections)), truth.outlier_share
    detections, outliers = simulate_detections(truth, q, camera[:, None], noise, share, noise_rng, outlier_rng, uv)
    moving = exact.measured((detections,), q=trajectory.values(np.zeros(count)))
    moved = replace(truth, q=frozen(q), outliers=frozen(outliers, np.intp), time_offsets=frozen(time_offsets))
    return replace(simulated, session=moving, truth=moved)


def _true_shutter(camera: Camera, rng: np.random.Generator) -> Camera:
    if not camera.rolling:
        return camera
    return replace(camera, line_time=camera.line_time + camera.line_time_sigma * rng.standard_normal())


def _by_rows(cameras: Sequence[Camera], camera: Ints, seen: Callable[[Floats], Floats]) -> Floats:
    """Where (N, 1, L, 2) cameras see LEDs that are in a row when it is taken, found in a few steps. [px]."""
    line = np.array([one.line_time for one in cameras])[camera]
    middle = np.array([(one.resolution[1] - 1) / 2.0 for one in cameras])[camera]
    uv = seen(np.zeros(len(camera)))
    # An LED at 1,000 px/s moves 1e-3 of the rows that pass meanwhile: each step wins two digits.
    for _ in range(_STEPS):
        for led in range(uv.shape[1]):
            late = line * np.nan_to_num(uv[:, led, 1] - middle)
            uv[:, led] = seen(late)[:, led]
    return uv[:, None]


@dataclass(frozen=True, eq=False)
class _Path:
    """Legs between poses, each from rest to rest: times (L + 1,) at the poses (L + 1, n)."""

    times: Floats
    poses: Floats

    @classmethod
    def through(cls, poses: Floats, speed: float) -> _Path:
        cruise = np.abs(np.diff(poses, axis=0)).max(axis=1) / speed
        # Of a leg too short for full speed the ramps are shorter, and no steeper.
        ramp = np.minimum(_RAMP, np.sqrt(_RAMP * cruise))
        return cls(_REST + np.concatenate([[0.0], np.cumsum(ramp + np.maximum(cruise, ramp))]), poses)

    @property
    def end(self) -> float:
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


def _tour(q: Floats, checker: CollisionChecker | None) -> Floats:
    """Order the poses ``q`` (N, n) into a tour through as many as have a free path to each other.

    The next is the nearest with a free path; from where there is none, the arm goes back the way it came. The tour
    begins where most poses are reached, and of these where it is shortest.
    """
    distance = np.abs(q[:, None] - q).max(axis=2)
    free = np.eye(len(q), dtype=bool)
    for a, b in zip(*np.triu_indices(len(q), 1), strict=True):
        free[a, b] = free[b, a] = _is_free(q[a], q[b], checker)
    walks = [_walk(np.where(free, distance, np.inf), first) for first in range(len(q))]
    walk = max(walks, key=lambda walk: (len(set(walk)), -float(distance[walk[:-1], walk[1:]].sum())))
    if len(walk) < 2:
        raise SessionError(
            "between no two poses there is a straight path in joint space that is free of collisions",
            where="simulate",
            remedy="Use another seed, or more poses.",
        )
    return q[walk]


def _walk(distance: Floats, first: int) -> list[int]:
    """Visit all that can be reached from ``first``; distances (N, N) are infinite where there is no path."""
    left, way, walk, last = set(range(len(distance))) - {first}, [first], [first], 1
    while left and way:
        following = min(left, key=lambda k: float(distance[way[-1], k]))
        if np.isfinite(distance[way[-1], following]):
            left.remove(following)
            way.append(following)
            walk.append(following)
            last = len(walk)
        else:
            way.pop()
            walk += way[-1:]
    return walk[:last]


def _is_free(a: Floats, b: Floats, checker: CollisionChecker | None) -> bool:
    if checker is None:
        return True
    steps = np.linspace(0.0, 1.0, 2 + int(np.abs(b - a).max() / _STRIDE))[1:]
    return all(checker.is_free(a + step * (b - a)) for step in steps)
