"""Which way round a target is that looks the same turned around: as the arm turned it, or the camera.

Between two pictures a target turns as much as what carries it does against what carries the camera. Read the other way
round in one of them, it would have turned by half a circle more or less, about its own normal. That holds
between moves of the camera and of the base; over them, it stays fastened as it is.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, evenly, inverse
from urdfcal.detection.led_frames import frames_in_base
from urdfcal.errors import CalibrationError, SessionError
from urdfcal.estimation.target_start import hand_eye, picture_poses
from urdfcal.session.moves import BASE_LINK, moves_before

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.session.model import Positions

# Pictures that each is compared with, and passes until all agree.
_OTHERS, _PASSES = 40, 5
# By so much (median) may the turns of target and arm differ where it is read the right way round, an arm as drawn and
# the pose of a flat target from one picture being what they are; and so much more must they differ the other way. [rad]
_MISS, _CLEARLY = 0.2, 0.3
# Read as elsewhere a target's points are so much nearer to where they are by that than if read otherwise: how it is
# fastened, as few pictures or the session tell it, may be off by 40 degrees where it has two ways, 25 where four.
_AS_FASTENED = 0.4
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
    of = positions.targets[target]
    orders = of.pattern.symmetries
    chosen: list[Ints | None] = [None] * len(views)
    stretches = list(_stretches(positions, target, views))
    fastened = {} if of.T_link_target is None else {0: of.T_link_target}
    alone, hidden = len(stretches) == 1 and not fastened, []
    # The longest first: the others are read as it is.
    for stretch in sorted(stretches, key=lambda each: -len(each.views)):
        turn, told = _agreeing(stretch.A, stretch.B)
        if told.any() and not alone:
            A = stretch.A[np.arange(len(turn)), turn][told]
            try:
                X = hand_eye(of.name, A[:, None], stretch.B[told])[1]
            except CalibrationError as error:
                hidden.append(_hidden(of.name, positions.rig.names[stretch.camera], error))
                continue
            known = stretch.world in fastened
            like = fastened.setdefault(stretch.world, next(iter(fastened.values()), X))
            steps, sure = _same(like, X, orders, of.points)
            turn, told = (turn + steps) % len(orders), told & (sure | (not known))
        for k, reading, sure in zip(stretch.views, turn.tolist(), told.tolist(), strict=True):
            chosen[k] = orders[reading] if sure else None
    if hidden and all(order is None for order in chosen):
        raise hidden[0]
    return chosen


def is_guessed(positions: Positions, target: int) -> bool:
    """Return whether it is taken to be the same way round as before the base moved: it stands in the world."""
    attachments = positions.attachments
    stands = attachments.carrier[attachments.first_target + target] == 0
    return bool(stands) and len(positions.targets[target].pattern.symmetries) > 1 and BASE_LINK in positions.moved


@dataclass(frozen=True, eq=False)
class _Stretch:
    """What one camera saw of a target, at K poses between which neither it nor the base was moved.

    Attributes:
        camera: index.
        world: the same number where what carries the target is the same: the base moves in a world.
        views: (K) which ones.
        A: (K, S, 4, 4) the target in the camera, by each reading; they turn it by a whole circle in S steps. [m]
        B: (K, 4, 4) what carries the target in what carries the camera. [m]
    """

    camera: int
    world: int
    views: tuple[int, ...]
    A: Floats
    B: Floats


def _stretches(positions: Positions, target: int, views: list[View]) -> Iterator[_Stretch]:
    attachments, of = positions.attachments, positions.targets[target]
    orders, T_base_frame = of.pattern.symmetries, frames_in_base(positions)
    carrier, bumps = attachments.carrier[attachments.first_target + target], moves_before(positions, BASE_LINK)
    for c, lens in enumerate(positions.rig.cameras):
        moves = moves_before(positions, BASE_LINK, lens.name)
        seen: defaultdict[int, list[tuple[int, list[Floats]]]] = defaultdict(list)
        for k, view in enumerate(views):
            good = np.isfinite(view.uv[:, 0])
            by_order = []
            for order in orders if view.camera == c else ():
                uv, kept = view.uv[order], good[order]
                _, T = picture_poses(lens, np.zeros(int(kept.sum()), np.intp), of.points[kept], uv[kept])
                by_order += [T[0, 0]] if len(T) else []
            if len(by_order) == len(orders):
                seen[moves[view.pose]].append((k, by_order))
        for together in seen.values():
            mine, A = zip(*together, strict=True)
            pose = np.array([views[k].pose for k in mine])
            B = inverse(T_base_frame[attachments.camera[c], pose]) @ T_base_frame[carrier, pose]
            yield _Stretch(c, 0 if carrier else int(bumps[pose[0]]), mine, np.array(A), B)


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


def _hidden(target: str, camera: str, error: CalibrationError) -> SessionError:
    what = f"target {target!r} looks the same turned around, and camera {camera!r} does not tell which way it is"
    return SessionError(f"{what}: {error.what}", where=f"targets.{target}", remedy=error.remedy)


def _same(like: Floats, X: Floats, orders: tuple[Ints, ...], points: Floats) -> tuple[int, bool]:
    """By how many steps a target fastened as X (4, 4) is read otherwise than one fastened ``like``, and if surely."""
    centred = points - points.mean(axis=0)
    theirs, mine = centred @ like[:3, :3].T, centred @ X[:3, :3].T
    # Read by a further order o, its point i is what was point o[i].
    apart = [float(np.linalg.norm(mine[order] - theirs, axis=1).mean()) for order in orders]
    nearest, next_to = np.sort(apart)[:2]
    return int(np.argmin(apart)), bool(nearest < _AS_FASTENED * next_to)


def _angle(R: Floats) -> Floats:
    result: Floats = np.arccos(np.clip(0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0), -1.0, 1.0))
    return result
