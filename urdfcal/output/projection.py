"""The arm drawn into a camera's image by its joint values alone (Rossi, Savino et al., eq. 22)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.output import fitted
from urdfcal.output.palette import CALIBRATED, MEASURED, NOMINAL
from urdfcal.output.placing import RobotPoses, row_lines

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from urdfcal.arrays import Floats
    from urdfcal.cameras.camera import Camera
    from urdfcal.output.fitted import ArmEstimate
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.robot.dh import DHTable

# A lens bends straight lines: each is projected at so many points.
_POINTS = 5
# So many images aside nothing is drawn: next to the plane of the lens pixels go to 1e13, which no viewer can take.
_FARTHEST = 100.0
# Subpixel bits of OpenCV's drawing.
_SHIFT = 4


def arm_in_image(calibration: FittedCalibration, q: ArrayLike, camera: int = 0, *, nominal: bool = False) -> Floats:
    """The pixels of the arm's axes and common normals at given joint values.

    Args:
        calibration: whose robot, base and cameras.
        q: (N, n) or (n,) joint values. [rad or m]
        camera: index.
        nominal: the nominal arm, placed to fit the measurements best, instead of the calibrated one.

    Returns:
        (N, P, 2) or (P, 2): a line from the base over all DH rows to the tip, in px; NaN behind the camera, and between
        the lines of an arm that branches.
    """
    arm = fitted.nominal(calibration) if nominal else fitted.calibrated(calibration)
    q = np.asarray(q, dtype=float)
    uv = arm_in_images(calibration, arm, np.atleast_2d(q))[camera]
    return uv if q.ndim == 2 else uv[0]


def arm_in_images(calibration: FittedCalibration, arm: ArmEstimate, q: Floats) -> list[Floats]:
    """The line (N, P, 2) of :func:`arm_in_image` in each camera, at joint values (N, n)."""
    poses = RobotPoses.of(calibration.session, arm, q)
    corners = skeleton(calibration.table, arm.row_offsets, poses.frames)
    return [project_line(camera, T, corners) for camera, T in zip(arm.cameras, poses.T_base_cam, strict=True)]


def project_line(camera: Camera, T_base_cam: Floats, corners: Floats) -> Floats:
    """Project lines into a camera's images, bent by the lens.

    Args:
        camera: the lens.
        T_base_cam: (N, 4, 4) where it is at each pose. [m]
        corners: (N, K, 3) in the base link's frame. [m]

    Returns:
        (N, P, 2) px; NaN behind the camera, and far outside of its image.
    """
    along = np.linspace(0.0, 1.0, _POINTS)[:-1, None]
    points = (1 - along) * corners[:, :-1, None] + along * corners[:, 1:, None]
    points = np.concatenate([points.reshape(len(corners), -1, 3), corners[:, -1:]], axis=1)
    T = inverse(T_base_cam)
    uv: Floats = camera.project(points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3])
    uv[np.abs(uv).max(axis=-1) > _FARTHEST * max(camera.resolution)] = np.nan
    return uv


def skeleton(table: DHTable, offsets: Floats, frames: Floats) -> Floats:
    """Corners of the arm's DH rows, (N, 2 n + 3, 3) in m in the base link's frame: base, F_0, foot, F_1, ..., tip.

    Of an arm that branches one such line after the other, NaN in between. Arguments as of :func:`row_lines`.
    """
    gap = np.full((len(frames), 1, 3), np.nan)
    lines = row_lines(table, offsets, frames)
    return np.concatenate([part for line in lines for part in (gap, line)][1:], axis=1)


def finite_pieces(uv: Floats) -> list[Floats]:
    """The stretches of a line (P, 2) that are in front of the camera."""
    ends = np.flatnonzero(np.diff(np.isfinite(uv).all(axis=1).astype(int))) + 1
    return [piece for piece in np.split(uv, ends) if len(piece) > 1 and np.isfinite(piece).all()]


def draw_image(
    image: NDArray[np.uint8] | tuple[int, int],
    lines: Sequence[tuple[str, Floats]],
    leds: Sequence[tuple[str, Floats]],
) -> NDArray[np.uint8]:
    """Draw arms and LEDs over a camera's image.

    Args:
        image: (h, w) or (h, w, 3), or only its (width, height).
        lines: kind (``nominal`` or ``calibrated``) and (P, 2) pixels, NaN where there are none.
        leds: kind (``detected``, ``nominal`` or ``calibrated``) and (K, 2) pixels.

    Returns:
        (h, w, 3) blue, green, red, as OpenCV writes it.
    """
    import cv2

    if isinstance(image, tuple):
        canvas = np.full((image[1], image[0], 3), 16, dtype=np.uint8)
    else:
        canvas = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
    size = max(canvas.shape) / 1000
    thickness = max(1, round(2 * size))
    for kind, uv in lines:
        for piece in finite_pieces(uv):
            cv2.polylines(canvas, [_fixed_point(piece)], False, _COLORS[kind], thickness, cv2.LINE_AA, _SHIFT)
    for kind, uv in leds:
        for centre in _fixed_point(uv[np.isfinite(uv).all(axis=-1)]):
            radius = round((9 if kind == "detected" else 5) * size * 2**_SHIFT)
            cv2.circle(canvas, centre.tolist(), radius, _COLORS[kind], thickness, cv2.LINE_AA, _SHIFT)
    return canvas


def _fixed_point(uv: Floats) -> NDArray[np.int32]:
    # Far outside of the image OpenCV's integers would overflow.
    result: NDArray[np.int32] = np.round(np.clip(uv, -(2.0**15), 2.0**15) * 2**_SHIFT).astype(np.int32)
    return result


_COLORS = {
    name: color[::-1] for name, color in (("detected", MEASURED), ("nominal", NOMINAL), ("calibrated", CALIBRATED))
}
