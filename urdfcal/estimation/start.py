"""A first state without any guess from the user: closed forms on the nominal arm (DESIGN section 6)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, inverse
from urdfcal.errors import CalibrationError
from urdfcal.estimation.observations import arrange
from urdfcal.estimation.state import State
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Geometry
    from urdfcal.session.model import Detections, Session
    from urdfcal.vision.rig import Rig

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


def first_state(session: Session, table: Geometry, offsets: Floats) -> State:
    """Place base, LEDs and cameras by what is seen.

    3-D points (measured, or triangulated where camera poses are known) give the base pose and the LED places
    in closed form; a camera of unknown pose is placed by PnP on the arm's LED positions. Of many poses an even
    selection serves.

    Args:
        session: what was measured.
        table: the arm's parameters.
        offsets: the arm to start from, of the table's shape; zeros for the arm as drawn.

    Raises:
        CalibrationError: too few sightings to place the base or a camera.
    """
    session = session.at(_selection(session))
    T_base_tip = tip_poses(session.chain, session.q, table.placements(offsets))
    guesses = np.array([np.zeros(3) if led.position is None else led.position for led in session.leds])
    unknown = np.array([led.position is None for led in session.leds])
    exact = np.array([led.sigma == 0.0 for led in session.leds])
    points = _points(session)
    T_world_base, leds = None, guesses
    # A few points where the cameras' views overlap are worth less than one camera's many sightings.
    if points is not None and (session.points is not None or len(points[2]) >= _ENOUGH):
        T_world_base, leds = place_base(T_base_tip, *points, guesses, unknown, exact)
    T_cam_world: list[Floats] = []
    cameras = session.rig.cameras if session.rig is not None and session.detections is not None else ()
    known = session.rig.T_cam_world if session.rig is not None and cameras else ()
    seen = (
        np.bincount(session.detections.camera, minlength=len(known)) if session.detections is not None else np.zeros(0)
    )
    if T_world_base is None and len(known):
        # By the camera of known pose that sees most; the first one's is the identity.
        places = {c: T for c, T in enumerate(known) if T is not None}
        c = max(places, key=lambda c: int(seen[c]))
        T_world_base = inverse(places[c]) @ resect(session, c, T_base_tip, leds)
    if T_world_base is None:
        raise CalibrationError("there are no sightings to start from")
    for c, T in enumerate(known):
        placed = np.eye(4) if T is None and not seen[c] else T  # a camera that sees nothing may stand anywhere
        T_cam_world.append(resect(session, c, T_base_tip, leds) @ inverse(T_world_base) if placed is None else placed)
    return State(
        offsets=offsets,
        T_world_base=T_world_base,
        leds=leds,
        cameras=tuple(cameras),
        T_cam_world=np.array(T_cam_world).reshape(-1, 4, 4),
    )


def _selection(session: Session) -> Ints:
    """Indices of poses spread evenly over the session, and over what each camera saw of each LED."""
    every = np.arange(len(session.poses))
    if len(every) <= _POSES:
        return every
    chosen = [_spread(every)]
    if session.detections is not None:
        d = session.detections
        views = d.camera * len(session.leds) + d.led
        chosen += [_spread(d.pose[views == view]) for view in np.unique(views)]
    if session.points is not None:
        chosen += [_spread(session.points.pose[session.points.led == led]) for led in np.unique(session.points.led)]
    return np.unique(np.concatenate(chosen))


def _spread(poses: Ints) -> Ints:
    """At most so many of them, evenly."""
    return poses[np.unique(np.linspace(0, len(poses) - 1, min(_POSES, len(poses))).astype(np.intp))]


def triangulated(session: Session) -> Observations | None:
    """The 3-D points of all LEDs seen by two or more cameras of known pose, with their covariances."""
    if session.rig is None or session.detections is None:
        return None
    pose, led, uv, sigma = _views(session.rig, session.detections)
    result = session.rig.triangulate(uv, sigma)
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
    )


def _points(session: Session) -> tuple[Ints, Ints, Floats] | None:
    """Pose, LED and world position of every 3-D point there is."""
    if session.points is not None:
        return session.points.pose, session.points.led, session.points.xyz
    found = triangulated(session)
    if found is None:
        return None
    group, slot = np.nonzero(found.valid)
    return found.pose[group], found.led[group, slot], found.value[group, slot]


def _views(rig: Rig, detections: Detections) -> tuple[Ints, Ints, Floats, Floats]:
    """Bring sightings of the same LED at the same pose side by side, NaN where a camera does not see it."""
    leds = int(detections.led.max()) + 1
    key, group = np.unique(detections.pose * leds + detections.led, return_inverse=True)
    uv = np.full((len(key), len(rig.cameras), 2), np.nan)
    sigma = np.ones((len(key), len(rig.cameras)))
    uv[group, detections.camera] = detections.uv
    sigma[group, detections.camera] = detections.sigma
    return key // leds, key % leds, uv, sigma


def place_base(
    T_base_tip: Floats, pose: Ints, led: Ints, points: Floats, guesses: Floats, unknown: Bools, exact: Bools
) -> tuple[Floats, Floats]:
    """Find T_world_base and the LED places that carry the arm onto measured points.

    The equations R^T P_k - R^T t - R_k led = p_k are linear once R^T is any matrix; its nearest rotation starts an
    alternation between Kabsch's alignment and the mean LED place. LEDs of given place start a second one; the
    better of the two is kept.

    Args:
        T_base_tip: (poses, 4, 4) of the nominal arm.
        pose: (S,) pose of each point.
        led: (S,) LED of each point.
        points: (S, 3) in the world. [m]
        guesses: (L, 3) LED places in the tip frame to start from. [m]
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
    R, p = T_base_tip[pose, :3, :3], T_base_tip[pose, :3, 3]
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


def resect(session: Session, camera: int, T_base_tip: Floats, leds: Floats) -> Floats:
    """T_cam_base by PnP on the nominal arm's LED positions."""
    import cv2

    if session.rig is None or session.detections is None:
        raise CalibrationError("there are no pictures to place a camera by")
    lens, d = session.rig.cameras[camera], session.detections
    mine = d.camera == camera
    rays = lens.unproject(d.uv[mine])[:, :2]
    T = T_base_tip[d.pose[mine]]
    objects = T[:, :3, 3] + (T[:, :3, :3] @ leds[d.led[mine]][..., None])[..., 0]
    good = np.isfinite(rays[:, 0])
    if good.sum() < 6:
        raise CalibrationError(
            f"camera {lens.name!r} has only {good.sum()} sightings: six or more are needed to place it",
            remedy="Measure more poses in its view, or give T_cn_cnm1 in the camera file.",
        )
    found, rvec, tvec, _ = cv2.solvePnPRansac(
        objects[good], rays[good], np.eye(3), None, reprojectionError=_PNP_TOLERANCE, flags=cv2.SOLVEPNP_SQPNP
    )
    if not found:
        raise CalibrationError(
            f"camera {lens.name!r} cannot be placed from its sightings",
            remedy="Check its intrinsics and that the sightings are of this robot's LEDs.",
        )
    T_cam_base = np.eye(4)
    T_cam_base[:3, :3] = cv2.Rodrigues(rvec)[0]
    T_cam_base[:3, 3] = tvec.ravel()
    return T_cam_base
