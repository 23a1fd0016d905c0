"""A first state without any guess from the user: closed forms on the nominal arm (DESIGN section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, evenly, inverse
from urdfcal.errors import CalibrationError
from urdfcal.estimation.observations import arrange
from urdfcal.estimation.state import State
from urdfcal.robot.kinematics import link_poses

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.cameras.rig import Rig
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Geometry
    from urdfcal.session.attachments import Frames
    from urdfcal.session.model import Detections, Session

# Alternations of base pose and LED places; the solver refines whatever is left.
_ALTERNATIONS = 20
_ENOUGH = 6
# LEDs that move by less have settled. [m]
_STILL = 1e-6
# More poses than this of each LED in each camera make the start no better than the solver needs it, only slower.
_POSES = 200
# Points this many times further off than the median are left out of the start.
_GROSS = 5.0
# PnP on LED places that are only roughly known (the LED may sit 0.1 m off the tip, 1 m away): outliers are
# what is farther off than this. [rad]
_PNP_TOLERANCE = 0.1
# Rays whose normal equations are worse conditioned meet nowhere in particular.
_MEETING = 1e6


def first_state(session: Session, table: Geometry, offsets: Floats) -> State:
    """Place base, LEDs and cameras by what is seen.

    3-D points (measured, or triangulated by cameras of known pose that stand still) give the base pose and the LED
    places in closed form; a camera of unknown pose is placed by PnP on the arm's LED positions, one that rides on a
    link in that link's frame. LEDs of unknown place that nothing else placed are put where the placed cameras' rays
    meet. Of many poses an even selection serves.

    Args:
        session: what was measured.
        table: the arm's parameters.
        offsets: the arm to start from, of the table's shape; zeros for the arm as drawn.

    Raises:
        CalibrationError: too few sightings to place the base or a camera.
    """
    session = session.at(_selection(session))
    frames, chain = session.frames, session.chain
    links = np.array(link_poses(chain, session.q, frames.tips, table.placements(offsets)))
    guesses = np.array([np.zeros(3) if led.position is None else led.position for led in session.leds])
    unknown = np.array([led.position is None for led in session.leds])
    exact = np.array([led.sigma == 0.0 for led in session.leds])
    T_world_base, leds = None, guesses
    points = _points(session)
    if points is not None:
        pose, led, xyz = (values[frames.led[points[1]] != 0] for values in points)
        # A few points where the cameras' views overlap are worth less than one camera's many sightings.
        if session.points is not None or len(xyz) >= _ENOUGH:
            T_base_led = links[frames.led[led] - 1, pose]
            T_world_base, leds = place_base(T_base_led, led, xyz, guesses, unknown, exact)
    cameras = session.rig.cameras if session.rig is not None and session.detections is not None else ()
    if not cameras and T_world_base is None:
        raise CalibrationError("there are no sightings to start from")
    view = View(session, links) if cameras else None
    T_cam_frame: list[Floats | None] = list(frames.T_cam_frame[: len(cameras)])
    if T_world_base is None and view is not None:
        T_world_base = view.base(T_cam_frame, leds) if len(frames.standing) else np.eye(4)
    if view is not None and T_world_base is not None:
        for c, T in enumerate(T_cam_frame):
            if T is None:
                T_cam_frame[c] = view.place(c, T_world_base, leds, _follower(frames, T_cam_frame, c))
        leds = view.meet(T_world_base, T_cam_frame, leds, unknown & ~_placed(frames, points, len(leds)))
    return State(
        offsets=offsets,
        T_world_base=np.eye(4) if T_world_base is None else T_world_base,
        leds=leds,
        cameras=tuple(cameras),
        T_cam_world=np.array(T_cam_frame).reshape(-1, 4, 4),
    )


def _follower(frames: Frames, T_cam_frame: Sequence[Floats | None], c: int) -> Floats | None:
    """Where a camera is by its leader, once that is placed."""
    T_cam_leader, T_leader_frame = frames.T_cam_leader[c], T_cam_frame[frames.leader[c]]
    return None if T_cam_leader is None or T_leader_frame is None else T_cam_leader @ T_leader_frame


def _placed(frames: Frames, points: tuple[Ints, Ints, Floats] | None, count: int) -> Bools:
    """Which LEDs the points in space have placed already."""
    placed = np.zeros(count, dtype=bool)
    if points is not None and len(points[2]) >= _ENOUGH:
        placed[np.unique(points[1])] = True
    result: Bools = placed & (frames.led != 0)
    return result


@dataclass(frozen=True, eq=False)
class View:
    """What the cameras saw, and how the links that carry LEDs and cameras were placed.

    Attributes:
        session: what was measured.
        links: (F, N, 4, 4) T_base_link of the session's frames 1, 2, ... at every pose. [m]
    """

    session: Session
    links: Floats

    def base(self, T_cam_frame: Sequence[Floats | None], leds: Floats) -> Floats:
        """T_world_base by PnP of the standing camera of known pose that sees most; the first one's is known."""
        detections = self.session.detections
        seen = np.bincount(detections.camera if detections is not None else [], minlength=len(T_cam_frame))
        places = {c: T for c in self.session.frames.standing if (T := T_cam_frame[c]) is not None}
        c = max(places, key=lambda c: int(seen[c]))
        return inverse(places[c]) @ self.resect(int(c), np.eye(4), leds)

    def place(self, c: int, T_world_base: Floats, leds: Floats, by_leader: Floats | None) -> Floats:
        """T_cam_frame of a camera of unknown pose: by the one that leads it, else by PnP."""
        if by_leader is not None:
            return by_leader
        detections = self.session.detections
        if detections is not None and not np.any(detections.camera == c):
            return np.eye(4)  # a camera that sees nothing may be anywhere
        return self.resect(c, T_world_base, leds)

    def meet(self, T_world_base: Floats, T_cam_frame: Sequence[Floats | None], leds: Floats, wanted: Bools) -> Floats:
        """Put LEDs (L, 3) where the rays that see them meet: least squares in their own frame, robust to no outlier.

        An LED that is not wanted, or whose rays are too few, stays where it is.
        """
        detections, rig, frames = self.session.detections, self.session.rig, self.session.frames
        if detections is None or rig is None or not np.any(wanted):
            return leds
        leds = leds.copy()
        for index in np.flatnonzero(wanted & np.isin(np.arange(len(leds)), detections.led)):
            A, b = np.zeros((3, 3)), np.zeros(3)
            for c, lens in enumerate(rig.cameras):
                rows = np.flatnonzero((detections.led == index) & (detections.camera == c))
                T_cam = T_cam_frame[c]
                if T_cam is None or not len(rows):
                    continue
                rays = lens.unproject(detections.uv[rows])
                good = np.isfinite(rays[:, 0])
                rays, pose = rays[good], detections.pose[rows[good]]
                T = T_cam @ self._between(pose, int(frames.led[index]), int(frames.camera[c]), T_world_base)
                rays /= np.linalg.norm(rays, axis=1, keepdims=True)
                across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
                A += np.sum(np.swapaxes(T[:, :3, :3], 1, 2) @ across @ T[:, :3, :3], axis=0)
                b -= np.sum((np.swapaxes(T[:, :3, :3], 1, 2) @ across @ T[:, :3, 3, None])[..., 0], axis=0)
            if np.linalg.cond(A) < _MEETING:
                leds[index] = np.linalg.solve(A, b)
        return leds

    def miss(self, c: int, leds: Floats) -> float:
        """How far (median, px) a camera sees the LEDs from where they are, the camera put where that is least.

        Raises:
            CalibrationError: there is no such place.
        """
        T_cam = self.resect(c, np.eye(4), leds)
        session = self.session
        rows, T = self._placed(c, np.eye(4))
        if session.rig is None or session.detections is None:
            return np.inf
        p_cam = (T_cam @ T @ np.insert(leds[session.detections.led[rows]], 3, 1.0, axis=1)[..., None])[:, :3, 0]
        uv = session.rig.cameras[c].project(p_cam)
        distance = np.linalg.norm(uv - session.detections.uv[rows], axis=1)
        return float(np.median(np.where(np.isfinite(distance), distance, np.inf)))

    def _placed(self, c: int, T_world_base: Floats) -> tuple[Ints, Floats]:
        """A camera's sightings of LEDs of roughly known place: their rows, and T_view_led (S, 4, 4) of their frames."""
        session, frames, d = self.session, self.session.frames, self.session.detections
        if d is None:
            return np.zeros(0, np.intp), np.zeros((0, 4, 4))
        given = np.array([led.position is not None for led in session.leds])
        # Where an LED stands in the world is known at most where the world is the base.
        known = (frames.led != 0) | (given & (frames.camera[c] != 0))
        mine = np.flatnonzero((d.camera == c) & known[d.led])
        T = np.empty((len(mine), 4, 4))
        for frame in np.unique(frames.led[d.led[mine]]):
            here = frames.led[d.led[mine]] == frame
            T[here] = self._between(d.pose[mine[here]], int(frame), int(frames.camera[c]), T_world_base)
        return mine, T

    def _between(self, pose: Ints, led_frame: int, view_frame: int, T_world_base: Floats) -> Floats:
        """T_view_led (S, 4, 4) of the frames that an LED and a camera are fixed in."""
        return inverse(self._frame(pose, view_frame, T_world_base)) @ self._frame(pose, led_frame, T_world_base)

    def _frame(self, pose: Ints, frame: int, T_world_base: Floats) -> Floats:
        if frame == 0:
            return np.broadcast_to(inverse(T_world_base), (len(pose), 4, 4))
        result: Floats = self.links[frame - 1, pose]
        return result

    def resect(self, camera: int, T_world_base: Floats, leds: Floats) -> Floats:
        """The camera's place in its frame (4, 4) by PnP on the nominal arm's LED positions."""
        import cv2

        session, d = self.session, self.session.detections
        if session.rig is None or d is None:
            raise CalibrationError("there are no pictures to place a camera by")
        lens = session.rig.cameras[camera]
        mine, T = self._placed(camera, T_world_base)
        rays = lens.unproject(d.uv[mine])[:, :2]
        objects = T[:, :3, 3] + (T[:, :3, :3] @ leds[d.led[mine]][..., None])[..., 0]
        good = np.isfinite(rays[:, 0])
        if good.sum() < _ENOUGH:
            raise CalibrationError(
                f"camera {lens.name!r} has only {good.sum()} sightings of LEDs whose place is roughly known: six or "
                "more are needed to place it",
                remedy="Measure more poses in its view, give its place, or the LEDs'.",
            )
        try:
            found, rvec, tvec, _ = cv2.solvePnPRansac(
                objects[good], rays[good], np.eye(3), None, reprojectionError=_PNP_TOLERANCE, flags=cv2.SOLVEPNP_SQPNP
            )
        except cv2.error:  # points that hardly differ
            found = False
        if not found:
            raise CalibrationError(
                f"camera {lens.name!r} cannot be placed from its sightings",
                remedy="Check its intrinsics and that the sightings are of this robot's LEDs.",
            )
        T_cam = np.eye(4)
        T_cam[:3, :3] = cv2.Rodrigues(rvec)[0]
        T_cam[:3, 3] = tvec.ravel()
        return T_cam


def _selection(session: Session) -> Ints:
    """Indices of poses spread evenly over the session, and over what each camera saw of each LED."""
    every = np.arange(len(session.poses))
    if len(every) <= _POSES:
        return every
    chosen = [evenly(every, _POSES)]
    if session.detections is not None:
        d = session.detections
        views = d.camera * len(session.leds) + d.led
        chosen += [evenly(d.pose[views == view], _POSES) for view in np.unique(views)]
    if session.points is not None:
        chosen += [
            evenly(session.points.pose[session.points.led == led], _POSES) for led in np.unique(session.points.led)
        ]
    return np.unique(np.concatenate(chosen))


def triangulated(session: Session) -> Observations | None:
    """The 3-D points of all LEDs seen by two or more standing cameras of known pose, with their covariances."""
    rig = _standing(session)
    if rig is None or session.detections is None:
        return None
    pose, led, uv, sigma = _views(session.frames.standing, session.detections)
    result = rig.triangulate(uv, sigma)
    good = np.isfinite(result.points[:, 0])
    if not np.any(good):
        return None
    return arrange(
        session.q,
        pose[good],
        led[good],
        np.full(good.sum(), -1),
        result.points[good],
        result.covariances[good],
        session.frames,
    )


def _standing(session: Session) -> Rig | None:
    """The cameras that stand still; the world is the first one's frame."""
    from urdfcal.cameras.rig import Rig

    frames, rig = session.frames, session.rig
    if rig is None or not len(frames.standing):
        return None
    return Rig(tuple(rig.cameras[c] for c in frames.standing), tuple(frames.T_cam_frame[c] for c in frames.standing))


def _points(session: Session) -> tuple[Ints, Ints, Floats] | None:
    """Pose, LED and world position of every 3-D point there is."""
    if session.points is not None:
        return session.points.pose, session.points.led, session.points.xyz
    found = triangulated(session)
    if found is None:
        return None
    group, slot = np.nonzero(found.valid)
    return found.pose[group], found.led[group, slot], found.value[group, slot]


def _views(cameras: Ints, detections: Detections) -> tuple[Ints, Ints, Floats, Floats]:
    """Bring some cameras' sightings of the same LED at the same pose side by side, NaN where one does not see it."""
    leds = int(detections.led.max()) + 1
    rows = np.flatnonzero(np.isin(detections.camera, cameras))
    key, group = np.unique(detections.pose[rows] * leds + detections.led[rows], return_inverse=True)
    uv, sigma = np.full((len(key), len(cameras), 2), np.nan), np.ones((len(key), len(cameras)))
    column = np.searchsorted(cameras, detections.camera[rows])
    uv[group, column], sigma[group, column] = detections.uv[rows], detections.sigma[rows]
    return key // leds, key % leds, uv, sigma


def place_base(
    T_base_led: Floats, led: Ints, points: Floats, guesses: Floats, unknown: Bools, exact: Bools
) -> tuple[Floats, Floats]:
    """Find T_world_base and the LED places that carry the arm onto measured points.

    The equations R^T P_k - R^T t - R_k led = p_k are linear once R^T is any matrix; its nearest rotation starts an
    alternation between Kabsch's alignment and the mean LED place. LEDs of given place start a second one; the
    better of the two is kept.

    Args:
        T_base_led: (S, 4, 4) of the link that carries each point's LED, on the nominal arm. [m]
        led: (S,) LED of each point.
        points: (S, 3) in the world. [m]
        guesses: (L, 3) LED places in their links' frames to start from. [m]
        unknown: (L,) LEDs whose guess is none.
        exact: (L,) LEDs whose guess is kept.

    Returns:
        T_world_base (4, 4) and leds (L, 3); LEDs never seen keep their guess.

    Raises:
        CalibrationError: fewer than four points.
    """
    least = 4 if np.any(unknown[led]) else 3
    if len(points) < least:
        raise CalibrationError(
            f"only {len(points)} points in space: {least} or more are needed to place the base",
            remedy="Measure more poses, or check that both cameras see the LED.",
        )
    R, p = T_base_led[:, :3, :3], T_base_led[:, :3, 3]
    seen = np.unique(led)
    kept = np.ones(len(points), dtype=bool)
    candidates = [guesses]
    if np.any(unknown[seen]):
        candidates.append(_linear_leds(R, p, led, points, guesses))
    best: tuple[float, Floats, Floats] | None = None
    for leds in candidates:
        for _ in range(2):  # once with all points, once without the grossly wrong ones
            T, leds = _alternate(R[kept], p[kept], led[kept], points[kept], leds, ~exact)
            predicted = (p + (R @ leds[led][..., None])[..., 0]) @ T[:3, :3].T + T[:3, 3]
            distance = np.linalg.norm(predicted - points, axis=1)
            kept = distance <= _GROSS * np.median(distance)
        score = float(np.median(distance))
        if best is None or score < best[0]:
            best = (score, T, leds)
        kept = np.ones(len(points), dtype=bool)
    return best[1], best[2]  # type: ignore[index]  # there is at least one candidate


def kabsch(source: Floats, target: Floats) -> Floats:
    """The rigid T (4, 4) that minimises sum |T source - target|^2, both (N, 3) (Kabsch, Acta Cryst. A32, 1976)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((source - a).T @ (target - b))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    T = np.eye(4)
    T[:3, :3] = Vt.T @ sign @ U.T
    T[:3, 3] = b - T[:3, :3] @ a
    return T


def _linear_leds(R: Floats, p: Floats, led: Ints, points: Floats, guesses: Floats) -> Floats:
    """LED places from the linear relaxation A P_k + s - R_k led = p_k."""
    S, L = len(points), len(guesses)
    system = np.zeros((S, 3, 12 + 3 * L))
    centred = points - points.mean(axis=0)
    for axis in range(3):
        system[:, axis, 3 * axis : 3 * axis + 3] = centred
        system[:, axis, 9 + axis] = 1.0
    for index in range(L):
        system[:, :, 12 + 3 * index : 15 + 3 * index] = -R * (led == index)[:, None, None]
    solution = np.linalg.lstsq(system.reshape(3 * S, -1), p.ravel(), rcond=1e-9)[0]
    return np.where(np.isin(np.arange(L), led)[:, None], solution[12:].reshape(L, 3), guesses)


def _alternate(R: Floats, p: Floats, led: Ints, points: Floats, leds: Floats, movable: Bools) -> tuple[Floats, Floats]:
    leds = leds.copy()
    for _ in range(_ALTERNATIONS):
        T = kabsch(p + (R @ leds[led][..., None])[..., 0], points)
        in_tip = (np.swapaxes(R, 1, 2) @ ((points - T[:3, 3]) @ T[:3, :3] - p)[..., None])[..., 0]
        before = leds.copy()
        for index in np.flatnonzero(movable & np.isin(np.arange(len(leds)), led)):
            leds[index] = np.median(in_tip[led == index], axis=0)
        if np.abs(leds - before).max() < _STILL:
            break
    return kabsch(p + (R @ leds[led][..., None])[..., 0], points), leds
