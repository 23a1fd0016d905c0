"""Which way round a target is that looks the same turned around: as the arm turned it, or the camera.

Between two pictures a target turns as much as what carries it does against what carries the camera. Read the other way
round in one of them, it would have turned by half a circle more or less, about its own normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, evenly, inverse
from urdfcal.detection.led_frames import frames_in_base
from urdfcal.errors import CalibrationError, SessionError
from urdfcal.estimation.target_start import hand_eye, picture_poses

if TYPE_CHECKING:
    from urdfcal.session.model import Positions

# Pictures that each is compared with, and passes until all agree.
_OTHERS, _PASSES = 40, 5
# By so much (median) may the turns of target and arm differ where it is read the right way round, an arm as drawn and
# the pose of a flat target from one picture being what they are; and so much more must they differ the other way. [rad]
_MISS, _CLEARLY = 0.2, 0.3
UNTOLD = "which way round it is does not show"


@dataclass(frozen=True, eq=False)
class View:
    """A target in a picture.

    Attributes:
        camera: index.
        pose: index.
        uv: (M, 2) its points in the order in which they were found, NaN where one was not. [px]
    """

    camera: int
    pose: int
    uv: Floats


def readings(positions: Positions, target: int, views: list[View]) -> list[Ints | None]:
    """Choose the order of the points in each picture, so that the target is the same way round in all of them.

    Which way that is does not matter, as its frame turns with it, unless the session says how it is fastened.

    Args:
        positions: the session.
        target: index of the target.
        views: of it.

    Returns:
        For each view the order (M,) of its points; None where that does not show.

    Raises:
        SessionError: the cameras do not tell from each other which way round it is.
    """
    attachments, of = positions.attachments, positions.targets[target]
    orders = of.pattern.symmetries
    T_base_frame = frames_in_base(positions)
    chosen: list[Ints | None] = [None] * len(views)
    first = of.T_link_target
    for c, lens in enumerate(positions.rig.cameras):
        mine = np.array([k for k, view in enumerate(views) if view.camera == c], dtype=np.intp)
        seen, T_cam_target = [], []
        for k in mine.tolist():
            good = np.isfinite(views[k].uv[:, 0])
            by_order = []
            for order in orders:
                uv, kept = views[k].uv[order], good[order]
                _, T = picture_poses(lens, np.zeros(int(kept.sum()), np.intp), of.points[kept], uv[kept])
                by_order += [T[0, 0]] if len(T) else []
            if len(by_order) == len(orders):
                seen.append(k)
                T_cam_target.append(by_order)
        if not seen:
            continue
        pose, A = np.array([views[k].pose for k in seen]), np.array(T_cam_target)
        carrier, frame = attachments.carrier[attachments.first_target + target], attachments.camera[c]
        B = inverse(T_base_frame[frame, pose]) @ T_base_frame[carrier, pose]
        turn, told = _agreeing(A, B)
        if told.any() and (first is not None or len(positions.rig.cameras) > 1):
            X = _fastened(of.name, lens.name, A[np.arange(len(A)), turn][told], B[told])
            first = X if first is None else first
            turn = (turn + _same(first, X, orders, of.points)) % len(orders)
        for k, reading, sure in zip(seen, turn.tolist(), told.tolist(), strict=True):
            chosen[k] = orders[reading] if sure else None
    return chosen


def _agreeing(A: Floats, B: Floats) -> tuple[Ints, Bools]:
    """Which reading (K,) of each picture agrees with the others, and whether that is sure.

    Args:
        A: (K, S, 4, 4) the target in the camera, by each reading; they turn it by a whole circle in S steps. [m]
        B: (K, 4, 4) what carries the target in what carries the camera. [m]
    """
    K, S = A.shape[:2]
    others = evenly(np.arange(K), _OTHERS)
    R, turned = A[:, 0, :3, :3], _angle(np.swapaxes(B[others, None, :3, :3], -1, -2) @ B[None, :, :3, :3])
    # How much (O, K, S) both turns differ if picture k is read by s more steps than the other.
    miss = np.stack(
        [np.abs(_angle(np.swapaxes(R[others, None], -1, -2) @ A[None, :, s, :3, :3]) - turned) for s in range(S)],
        axis=-1,
    )
    reading = np.argmin(miss[int(np.argmin(np.median(miss.min(axis=-1), axis=1)))], axis=-1)
    for _ in range(_PASSES):
        # Of picture k by reading r: with the others read as they are.
        steps = (np.arange(S)[None, None] - reading[others][:, None, None]) % S
        cost = np.median(np.take_along_axis(miss, np.broadcast_to(steps, miss.shape), axis=-1), axis=0)
        again = np.argmin(cost, axis=-1)
        if np.array_equal(again, reading):
            break
        reading = again
    ordered = np.sort(cost, axis=-1)
    told = (ordered[:, 0] < _MISS) & (ordered[:, 1] - ordered[:, 0] > _CLEARLY)
    return reading, told


def _fastened(target: str, camera: str, A: Floats, B: Floats) -> Floats:
    """Where the target is fastened (4, 4), as one camera sees it. [m]."""
    try:
        return hand_eye(target, A[:, None], B)[1]
    except CalibrationError as error:
        what = f"target {target!r} looks the same turned around, and camera {camera!r} does not tell which way it is"
        raise SessionError(f"{what}: {error.what}", where=f"targets.{target}", remedy=error.remedy) from error


def _same(first: Floats, X: Floats, orders: tuple[Ints, ...], points: Floats) -> int:
    """By how many steps a camera reads the target otherwise than the first one does, given where both have it."""
    theirs, mine = (points @ T[:3, :3].T + T[:3, 3] for T in (first, X))
    # Read by a further order o, its point i is what was point o[i].
    apart = [float(np.linalg.norm(mine[order] - theirs, axis=1).mean()) for order in orders]
    return int(np.argmin(apart))


def _angle(R: Floats) -> Floats:
    result: Floats = np.arccos(np.clip(0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0), -1.0, 1.0))
    return result
