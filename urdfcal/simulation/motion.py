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
from urdfcal.simulation.moving import REST, JointPath, Moving, pixels_by_row
from urdfcal.simulation.planning import load_collision_checker
from urdfcal.simulation.scene import noisy_values, simulate_detections

if TYPE_CHECKING:
    from urdfcal.cameras.camera import Camera
    from urdfcal.simulation.planning import CollisionChecker
    from urdfcal.simulation.truth import Simulated

# Keeps the motion's random numbers apart from the session's.
_STREAM = 5
# Cameras film a little less than the joints' log is long. [s]
_DARK = 0.25
# A path is checked for collisions this often. [rad or m]
_STRIDE = 0.1
# What the time offsets of cameras are within if nobody says. [s]
_OFFSET = 0.03


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
    path = JointPath.through(_tour(truth.readings, checker), settings.speed)
    log_time = np.arange(0.0, path.end + REST, 1.0 / settings.joint_rate)
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
    cameras, moving = tuple(_true_shutter(one, offset_rng) for one in truth.cameras), Moving(path, exact, time, camera)
    moved = replace(truth, cameras=cameras, q=frozen(q), time_offsets=frozen(time_offsets), moving=moving)
    uv = None if moved.rolling is None else pixels_by_row(moved, moved.rolling)[:, None]
    noise, share = (truth.pixel, session.noise.of(Detections)), truth.outlier_share
    detections, outliers = simulate_detections(moved, q, camera[:, None], noise, share, noise_rng, outlier_rng, uv)
    filmed = exact.measured((detections,), q=trajectory.values(np.zeros(count)))
    return replace(simulated, session=filmed, truth=replace(moved, outliers=frozen(outliers, np.intp)))


def _true_shutter(camera: Camera, rng: np.random.Generator) -> Camera:
    if not camera.rolling:
        return camera
    return replace(camera, line_time=camera.line_time + camera.line_time_sigma * rng.standard_normal())


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
