"""Place targets of unknown pose: PnP in every picture, then hand-eye calibration in closed form (METHOD 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, Ints, inverse
from urdfcal.errors import CalibrationError
from urdfcal.estimation.blocks.base_pose import base_keys
from urdfcal.estimation.blocks.targets import target_key

if TYPE_CHECKING:
    from collections.abc import Iterable

    from urdfcal.cameras.camera import Camera
    from urdfcal.estimation.measurements import Measurement
    from urdfcal.estimation.start import Start
    from urdfcal.estimation.state import State

# A flat target's pose comes with a mirrored twin; both fit where it is small or far away.
_HYPOTHESES = 2
# Passes in which every picture's hypothesis is chosen by what the others say.
_PASSES = 5
# Pictures this many times further off than the median are left out.
_GROSS = 5.0
# Rotations about one axis alone leave the place along it open: the weakest singular value of their equations. [rad]
_SAME_AXIS = 0.02
_FEWEST_POINTS, _FEWEST_VIEWS = 4, 3


@dataclass(frozen=True, eq=False)
class TargetViews:
    """Where a target was seen to be.

    Attributes:
        target: index of it.
        frame: of the attachments that the viewer is fixed in.
        T_viewer_frame: (4, 4) how, None where that is not known. [m]
        pose: (K,) index of each view's pose.
        T_viewer_target: (K, H, 4, 4) hypotheses, the best one first. [m]
    """

    target: int
    frame: int
    T_viewer_frame: Floats | None
    pose: Ints
    T_viewer_target: Floats


def place_targets(at: Start, tables: Iterable[Measurement], state: State) -> State:
    """Find targets of unknown pose by what sees them most, and with them the base where a viewer of known place does.

    What stands in the world and is seen from a link needs the base: without it, it is left for later.

    Args:
        at: the session, and where the links of the nominal arm are.
        tables: the measurements.
        state: what is known so far.

    Returns:
        The state with the poses that were found.

    Raises:
        CalibrationError: what sees a target does not tell its pose.
    """
    attachments = at.session.attachments
    wanted = [name for name in attachments.targets if target_key(name) not in state]
    if not wanted:
        return state
    views = sorted((of for table in tables for of in table.target_views(at.session)), key=lambda of: -len(of.pose))
    part, bases = at.session.part, base_keys(attachments.parts)
    for t, (name, carrier) in enumerate(attachments.carried):
        for view in (of for of in views if of.target == t and len(of.pose) and target_key(name) not in state):
            T_viewer_frame = view.T_viewer_frame
            # Each part has its own world: of several, the one with most views.
            most = int(np.argmax(np.bincount(part[view.pose])))
            here, base = part[view.pose] == most, bases[most]
            pose, seen = view.pose[here], view.T_viewer_target[here]
            if view.frame == carrier:
                if T_viewer_frame is not None:
                    state = state.replace({target_key(name): mean_pose(inverse(T_viewer_frame) @ seen[:, 0])})
            elif carrier or base in state:
                B = inverse(at.frame(view.frame, pose, state)) @ at.frame(carrier, pose, state)
                Y, X = hand_eye(name, seen, B)
                state = state.replace({target_key(name): X})
                if base not in state and view.frame == 0 and T_viewer_frame is not None:
                    state = state.replace({base: inverse(T_viewer_frame) @ Y})
    return state


def picture_poses(lens: Camera, pose: Ints, points: Floats, uv: Floats) -> tuple[Ints, Floats]:
    """Find a target's pose in every picture by PnP.

    Args:
        lens: of the camera.
        pose: (S,) picture that each detection is of, in ascending order.
        points: (S, 3) in the target's frame. [m]
        uv: (S, 2) where they were seen. [px]

    Returns:
        The pictures (K,) that show four points or more, and T_cam_target (K, 2, 4, 4): the pose that fits best and its
        mirrored twin, or the same again. [m]
    """
    import cv2

    rays = lens.unproject(uv)[:, :2]
    good = np.isfinite(rays[:, 0])
    pose, points, rays = pose[good], points[good], rays[good]
    found, poses = [], []
    for k in np.unique(pose).tolist():
        mine = pose == k
        if np.count_nonzero(mine) < _FEWEST_POINTS:
            continue
        flat = np.ptp(points[mine][:, 2]) == 0.0
        method = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
        try:
            _, rvecs, tvecs, _ = cv2.solvePnPGeneric(points[mine], rays[mine], np.eye(3), None, flags=method)
        except cv2.error:  # points on a line
            continue
        hypotheses = [_transform(cv2.Rodrigues(r)[0], t.ravel()) for r, t in zip(rvecs, tvecs, strict=True)]
        if hypotheses:
            found.append(k)
            poses.append((hypotheses * _HYPOTHESES)[:_HYPOTHESES])
    return np.array(found, dtype=np.intp), np.array(poses).reshape(-1, _HYPOTHESES, 4, 4)


def space_poses(pose: Ints, points: Floats, xyz: Floats) -> tuple[Ints, Floats]:
    """Find a target's pose from points in space at every pose, by Kabsch's alignment.

    Args:
        pose: (S,) pose that each point was measured at, in ascending order.
        points: (S, 3) in the target's frame. [m]
        xyz: (S, 3) measured. [m]

    Returns:
        The poses (K,) with three points or more off one line, and T (K, 1, 4, 4) of the target there. [m]
    """
    found, poses = [], []
    for k in np.unique(pose).tolist():
        p, x = points[pose == k], xyz[pose == k]
        U, s, Vt = np.linalg.svd((x - x.mean(axis=0)).T @ (p - p.mean(axis=0)))
        if len(p) >= 3 and s[1] > 1e-6 * s[0]:
            R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
            found.append(k)
            poses.append([_transform(R, x.mean(axis=0) - R @ p.mean(axis=0))])
    return np.array(found, dtype=np.intp), np.array(poses).reshape(-1, 1, 4, 4)


def hand_eye(name: str, A: Floats, B: Floats) -> tuple[Floats, Floats]:
    """Solve A_k = Y B_k X for constant Y and X: linear in Y^T and X as rotations, then in both places.

    Dornaika & Horaud 1998 (AX = ZB) with any matrices for the rotations, whose nearest ones are taken. Of each
    picture's hypotheses the one that fits is used, and pictures far off are left out.

    Args:
        name: of the target, for messages.
        A: (K, H, 4, 4) of the target in what sees it. [m]
        B: (K, 4, 4) of what carries the target in what carries the viewer. [m]

    Returns:
        Y and X (4, 4). [m]

    Raises:
        CalibrationError: there are too few views, or the arm hardly turned between them.
    """
    if len(A) < _FEWEST_VIEWS:
        raise CalibrationError(
            f"target {name!r} was seen whole enough to be placed in {len(A)} poses: three are needed",
            remedy="Measure it in more poses, or give its pose (position and rpy).",
        )
    each, chosen, kept = np.arange(len(A)), np.zeros(len(A), dtype=np.intp), np.ones(len(A), dtype=bool)
    reach = float(np.median(np.linalg.norm(A[:, 0, :3, 3], axis=1))) or 1.0
    for _ in range(_PASSES):
        Y, X, weakest = _solve(A[each, chosen][kept], B[kept])
        predicted = Y @ B @ X
        apart = np.linalg.norm((predicted[:, None] - A)[..., :3, 3], axis=-1) / reach
        apart = apart + np.linalg.norm((predicted[:, None] - A)[..., :3, :3], axis=(-2, -1))
        before = chosen, kept
        chosen = np.argmin(apart, axis=1)
        best = apart[each, chosen]
        kept = best <= _GROSS * np.median(best)
        if np.array_equal(chosen, before[0]) and np.array_equal(kept, before[1]):
            break
    if weakest < _SAME_AXIS:
        raise CalibrationError(
            f"the arm turned about one axis alone, or hardly at all, while target {name!r} was seen: where it is "
            "fastened does not show",
            remedy="Turn it about several axes, or give its pose (position and rpy).",
        )
    return Y, X


def _solve(A: Floats, B: Floats) -> tuple[Floats, Floats, float]:
    """Y and X, and how well two axes of rotation differ: 0 where all rotations are about one."""
    K = len(A)
    RA, RB = A[:, :3, :3], B[:, :3, :3]
    # Y^T RA - RB X = 0, in the entries of Y^T and X, row by row.
    M = np.zeros((K, 9, 18))
    for i in range(3):
        M[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = np.swapaxes(RA, 1, 2)
        for j in range(3):
            M[:, 3 * i + j, 9 + j :: 3] = -RB[:, i]
    _, s, Vt = np.linalg.svd(M.reshape(-1, 18), full_matrices=False)
    Yt, X = Vt[-1, :9].reshape(3, 3), Vt[-1, 9:].reshape(3, 3)
    if np.linalg.det(X) < 0.0:
        Yt, X = -Yt, -X
    RY, RX = _nearest_rotation(Yt).T, _nearest_rotation(X)
    # tA = RY (RB tX + tB) + tY.
    C = np.concatenate([RY @ RB, np.broadcast_to(np.eye(3), (K, 3, 3))], axis=2).reshape(-1, 6)
    d = (A[:, :3, 3] - B[:, :3, 3] @ RY.T).ravel()
    t = np.linalg.lstsq(C, d, rcond=1e-9)[0]
    return _transform(RY, t[3:]), _transform(RX, t[:3]), float(s[-2] / np.sqrt(K))


def mean_pose(T: Floats) -> Floats:
    """Return the robust mean (4, 4) of poses (K, 4, 4): rotations by their nearest mean, places by their median."""
    R = T[:, :3, :3]
    mean = _nearest_rotation(np.median(R, axis=0))
    return _transform(mean, np.median(T[:, :3, 3], axis=0))


def _nearest_rotation(M: Floats) -> Floats:
    U, _, Vt = np.linalg.svd(M)
    R: Floats = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return R


def _transform(R: Floats, t: Floats) -> Floats:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T
