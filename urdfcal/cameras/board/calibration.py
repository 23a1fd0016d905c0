"""Cameras from images of a board: which images are used, how well the cameras are known, and when not at all."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, frozen
from urdfcal.cameras.board.bundle import Adjusted, Bundle, adjust
from urdfcal.cameras.board.start import board_poses, first_guesses, place
from urdfcal.cameras.board.views import Rejection
from urdfcal.cameras.rig import CameraSigma, Rig
from urdfcal.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.cameras.board.board import Board
    from urdfcal.cameras.board.views import BoardViews
    from urdfcal.cameras.camera import Camera

# A view adds 6 unknowns of its own; with fewer corners, or all in two rows, it says nothing about the lens.
_FEWEST_CORNERS, _FEWEST_ROWS = 8, 2
# Three views tell lens and poses; of fewer than this the standard deviations are themselves uncertain.
_FEWEST_VIEWS, _FEW_VIEWS = 3, 8
# The rms of 54 corners varies by 7 % between views, with distance and light by a factor of two.
_FAR_ABOVE = 3.0
_MOST_LEFT_OUT = 0.2
# At 0.05 px of noise, 20 views within 8° of the image plane tell f to 0.6 to 1 %, within 45° to 0.05 %; and a sheet
# of paper that is not quite flat then looks like another focal length.
_LEAST_TILT = 10.0
# A focal length off by 0.5 % puts an LED 1.5 m away off by 7 mm: more than the arm's own errors.
_WORST_FOCAL = 0.005
# Beyond this the prior says nothing that the printed focal length of the lens does not.
_HOPELESS_FOCAL = 0.05
# k3 is used where it is this many of its standard deviations from zero.
_SIGNIFICANT = 3.0
# A start that ends here has found the camera; others end at tens of px or leave corners out.
_GOOD_SIGMA, _GOOD_SHARE = 0.5, 0.02
_GRID = (8, 6)
# Half of the image without a corner leaves the distortion there to extrapolation.
_LEAST_COVERAGE = 0.5
_TILT_THE_BOARD = "Add images with the board turned by 20° to 45° to either side, and up and down."
_AT_THE_SAME_TIME = "Images of one name must be taken at the same time, or with the board held still; check the names."
# Corners of rendered images without noise fit to a few thousandths of a pixel, and then anything is far above.
_LEAST_NOISE = 0.01
_POSE_AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class CameraQuality:
    """How well one camera was seen to.

    Attributes:
        name: the camera's.
        views: names of the views used.
        rms: of each view's residuals (both coordinates of all corners used), px.
        tilts: of each view's board against the image plane, degrees.
        sigma: standard deviation of a corner's coordinate, px.
        corners: number of corners used.
        outliers: number of corners left out.
        covered: (6, 8) which cells of the image hold a corner.
    """

    name: str
    views: tuple[str, ...]
    rms: Floats
    tilts: Floats
    sigma: float
    corners: int
    outliers: int
    covered: Bools

    @property
    def coverage(self) -> float:
        """Share of the image's cells that hold a corner."""
        return float(self.covered.mean())


@dataclass(frozen=True, eq=False)
class BoardCalibration:
    """Calibrated cameras.

    Attributes:
        board: what the images show.
        rig: the cameras with their places, standard deviations and correlations.
        covariance: (P, P) of all cameras' parameters.
        names: of these parameters, camera by camera: the lens, then the place of those that have one but the first
            (m and rad, a small motion in the camera's frame after T_cam_world).
        qualities: of each camera.
        rejected: images not used.
        warnings: what to mind.
    """

    board: Board
    rig: Rig
    covariance: Floats
    names: tuple[str, ...]
    qualities: tuple[CameraQuality, ...]
    rejected: tuple[Rejection, ...]
    warnings: tuple[str, ...]


def calibrate_cameras(
    views: BoardViews, board: Board, model: str = "radtan", *, force: bool = False
) -> BoardCalibration:
    """Estimate lenses and places of all cameras, with their covariance.

    Every camera is calibrated alone first; those that views in common link to the first one then all together in one
    least squares.

    Args:
        views: what the cameras saw.
        board: of what.
        model: "radtan" (k3 only where the corners ask for it), "equidistant" or "none".
        force: go on where the views leave the focal length open or the cameras disagree, with a warning.

    Raises:
        CameraError: too few or too parallel views, or corners that fit no camera; says what images to add.
    """
    uv, rejected = _usable(views, board)
    warnings: list[str] = []

    def mind(doubt: CameraError | None) -> None:
        if doubt is None:
            return
        if not force:
            remedy = f"{doubt.remedy} Or --force takes them as they are."
            raise CameraError(doubt.what, where=doubt.where, remedy=remedy)
        warnings.append(f"{doubt.where}: {doubt.what}. {doubt.remedy}")

    alone: list[Adjusted] = []
    for c, name in enumerate(views.cameras):
        _check_views(views, c, uv, rejected)
        camera = _alone(name, views.resolutions[c], model, board, uv[c], views.covariance[c])
        dropped, fitted = _without_bad_views(board, (camera,), uv[c : c + 1], views, (c,))
        rejected += dropped
        for rejection in dropped:
            uv[c, views.views.index(rejection.view)] = np.nan
        _check_views(views, c, uv, rejected)
        mind(_open_focal(fitted, name))
        alone.append(fitted)

    cameras = [fitted.bundle.cameras[0] for fitted in alone]
    placed, _, _ = place(cameras, board, uv)
    together = [c for c, T in enumerate(placed) if T is not None]
    fits: dict[int, tuple[Adjusted, int]] = {}
    for group in [together, *([c] for c, T in enumerate(placed) if T is None)]:
        dropped, fitted = _without_bad_views(board, [cameras[c] for c in group], uv[group], views, group)
        rejected += dropped
        for i, c in enumerate(group):
            fits[c] = fitted, i
            mind(_disagreeing(cameras[c].name, float(alone[c].sigma[0]), float(fitted.sigma[i])))
    return _result(views, board, fits, rejected, warnings)


def _usable(views: BoardViews, board: Board) -> tuple[Floats, list[Rejection]]:
    """The corners without views that show too little."""
    uv, rejected = np.array(views.uv), list(views.rejected)
    across = board.shape[0]
    for c, v in np.argwhere(np.isfinite(uv[..., 0]).any(axis=2)):
        seen = np.flatnonzero(np.isfinite(uv[c, v, :, 0]))
        rows, columns = len(np.unique(seen // across)), len(np.unique(seen % across))
        if len(seen) >= _FEWEST_CORNERS and min(rows, columns) > _FEWEST_ROWS:
            continue
        reason = f"only {len(seen)} of {uv.shape[2]} corners are found, in {rows} rows and {columns} columns"
        uv[c, v] = np.nan
        rejected.append(Rejection(views.cameras[c], views.views[v], reason))
    return uv, rejected


def _check_views(views: BoardViews, c: int, uv: Floats, rejected: Sequence[Rejection]) -> None:
    count = int(np.isfinite(uv[c, ..., 0]).any(axis=1).sum())
    if count >= _FEWEST_VIEWS:
        return
    # What follows the colon is different in every image.
    reasons = Counter(r.reason.split(":")[0] for r in rejected if r.camera == views.cameras[c]).most_common()
    because = f" ({'; '.join(f'{times} x {reason}' for reason, times in reasons[:3])})" if reasons else ""
    what = f"only {count} of its images can be used{because}, at least {_FEWEST_VIEWS} are needed and 15 to 30 are good"
    remedy = "Add sharp images of the board in all parts of the image, and check the board's kind and its counts."
    raise CameraError(what, where=f"camera '{views.cameras[c]}'", remedy=remedy)


def _open_focal(fitted: Adjusted, name: str) -> CameraError | None:
    """What to object to views that leave the focal length open."""
    camera = fitted.bundle.cameras[0]
    seen = np.isfinite(fitted.residuals[0, ..., 0]).any(axis=1)
    tilts = _tilts(fitted.bundle, 0)[seen]
    if tilts.max() < _LEAST_TILT:
        return CameraError(
            f"the board faces the camera in all images (tilted by at most {tilts.max():.0f}°): a longer lens further "
            "away would see the same",
            where=f"camera '{name}'",
            remedy=_TILT_THE_BOARD,
        )
    relative = float((np.sqrt(np.diag(fitted.covariance)[:2]) / camera.intrinsics[:2]).max())
    if relative < _HOPELESS_FOCAL:
        return None
    what = f"these images tell the focal length only to {100 * relative:.2g} % (standard deviation)"
    return CameraError(what, where=f"camera '{name}'", remedy=_TILT_THE_BOARD)


def _disagreeing(name: str, alone: float, together: float) -> CameraError | None:
    """What to object to a camera that agrees with itself but not with the others."""
    if together <= _FAR_ABOVE * max(alone, _LEAST_NOISE):
        return None
    what = f"its corners fit to {alone:.2g} px alone, but to {together:.2g} px together with the other cameras"
    return CameraError(what, where=f"camera '{name}'", remedy=_AT_THE_SAME_TIME)


def _alone(name: str, resolution: tuple[int, int], model: str, board: Board, uv: Floats, covariance: Floats) -> Camera:
    """One camera from all its views, from the start that explains them best."""
    shown = np.isfinite(uv[..., 0]).any(axis=1)
    uv, covariance = uv[shown], covariance[shown]
    best: Adjusted | None = None
    failure: CameraError | None = None
    for guess in first_guesses(name, resolution, model, board, uv):
        try:
            fitted = adjust(
                Bundle(board, (guess,), np.eye(4)[None], board_poses(guess, board, uv)), uv[None], covariance[None]
            )
        except CameraError as error:
            failure = failure or error
            continue
        if best is None or _merit(fitted) < _merit(best):
            best = fitted
        left_out = best.outliers.sum() / np.isfinite(best.residuals[..., 0]).sum()
        if best.sigma[0] < _GOOD_SIGMA and left_out < _GOOD_SHARE:
            break
    if best is None:
        raise CameraError(failure.what if failure else "", where=f"camera '{name}'", remedy=_TILT_THE_BOARD)
    camera = best.bundle.cameras[0]
    if model != "radtan":
        return camera
    longer = replace(camera, distortion=np.append(camera.distortion, 0.0))
    try:
        fitted = adjust(replace(best.bundle, cameras=(longer,)), uv[None], covariance[None])
    except CameraError:
        return camera
    k3 = fitted.bundle.cameras[0].distortion[-1]
    return fitted.bundle.cameras[0] if abs(k3) > _SIGNIFICANT * np.sqrt(fitted.covariance[-1, -1]) else camera


def _merit(fitted: Adjusted) -> float:
    """Median residual, which no left-out corner flatters."""
    return float(np.nanmedian(np.linalg.norm(fitted.residuals, axis=-1)))


def _without_bad_views(
    board: Board, cameras: Sequence[Camera], uv: Floats, views: BoardViews, group: Sequence[int]
) -> tuple[list[Rejection], Adjusted]:
    """Fit, leave out the image that fits worst if it fits far worse than the others, and fit again."""
    uv, covariance = np.array(uv), views.covariance[list(group)]
    rejected: list[Rejection] = []
    while True:
        T_cam_world, T_world_board, orders = place(cameras, board, uv)
        uv = np.take_along_axis(uv, orders[..., None], axis=2)
        covariance = np.take_along_axis(covariance, orders[..., None, None], axis=2)
        T_world_board[np.isnan(T_world_board[:, 0, 0])] = np.eye(4)
        placed = [T for T in T_cam_world if T is not None]
        if len(placed) < len(cameras):
            lost = next(camera for camera, T in zip(cameras, T_cam_world, strict=True) if T is None)
            what = "no image it shares with another camera agrees with the rest"
            raise CameraError(what, where=f"camera '{lost.name}'", remedy=_AT_THE_SAME_TIME)
        fitted = adjust(Bundle(board, tuple(cameras), np.stack(placed), T_world_board), uv, covariance)
        kept = np.where(fitted.outliers, np.nan, fitted.norms)
        # A few corners left out are a reflection or a finger; many are a bad view, judged by all its corners.
        few = fitted.outliers.sum(axis=2) <= _MOST_LEFT_OUT * np.isfinite(uv[..., 0]).sum(axis=2)
        norms = _rms(np.where(few[..., None], kept, fitted.norms))
        ratio = np.nan_to_num(norms / np.maximum(np.nanmedian(norms, axis=1), 1e-3)[:, None])
        c, v = (int(i) for i in np.unravel_index(ratio.argmax(), ratio.shape))
        if ratio[c, v] < _FAR_ABOVE:
            return rejected, fitted
        uv[c, v] = np.nan
        # Between several cameras the odd view is one where the board or the exposure moved.
        cause = "was the board bent or read wrongly?" if len(group) == 1 else "did the board move between the cameras?"
        far = np.linalg.norm(fitted.residuals[c, v], axis=-1)
        reason = f"its residual {_rms(far) / np.sqrt(2.0):.2f} px is {ratio[c, v]:.0f} x that of the others: {cause}"
        rejected.append(Rejection(views.cameras[group[c]], views.views[v], reason))


def _rms(lengths: Floats) -> Floats:
    """Root mean square over the last axis, NaN where there is nothing."""
    seen = np.isfinite(lengths)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt((np.where(seen, lengths, 0.0) ** 2).sum(axis=-1) / seen.sum(axis=-1)))


def _tilts(bundle: Bundle, c: int) -> Floats:
    """(V,) angle between board and image plane, degrees."""
    z = (bundle.T_cam_world[c] @ bundle.T_world_board)[:, 2, 2]
    return np.asarray(np.degrees(np.arccos(np.clip(np.abs(z), 0.0, 1.0))))


def _quality(views: BoardViews, c: int, fitted: Adjusted, i: int) -> CameraQuality:
    residuals = fitted.residuals[i]
    used = np.isfinite(residuals[..., 0]).any(axis=1)
    kept = np.isfinite(residuals[..., 0]) & ~fitted.outliers[i]
    cells = np.floor((views.uv[c][kept] + 0.5) / np.array(views.resolutions[c]) * _GRID).astype(int)
    covered = np.zeros(_GRID[::-1], dtype=bool)
    covered[tuple(np.clip(cells, 0, np.array(_GRID) - 1).T[::-1])] = True
    return CameraQuality(
        name=views.cameras[c],
        views=tuple(name for name, ok in zip(views.views, used, strict=True) if ok),
        rms=frozen(_rms(np.where(kept, np.linalg.norm(residuals, axis=-1), np.nan))[used] / np.sqrt(2.0)),
        tilts=frozen(_tilts(fitted.bundle, i)[used]),
        sigma=float(fitted.sigma[i]),
        corners=int(kept.sum()),
        outliers=int(fitted.outliers[i].sum()),
        covered=frozen(covered, bool),
    )


def _result(
    views: BoardViews,
    board: Board,
    fits: dict[int, tuple[Adjusted, int]],
    rejected: Sequence[Rejection],
    doubts: Sequence[str],
) -> BoardCalibration:
    names: list[str] = []
    blocks: list[tuple[Adjusted, Ints]] = []
    for c in range(len(views.cameras)):
        fitted, i = fits[c]
        camera, columns = fitted.bundle.cameras[i], fitted.bundle.columns[i]
        blocks.append((fitted, columns))
        names += [f"{camera.name}.{name}" for name in (*camera.parameter_names, *_POSE_AXES)[: len(columns)]]
    # Cameras that were not fitted together know nothing of each other.
    covariance = np.block(
        [
            [fit.covariance[np.ix_(a, b)] if fit is other else np.zeros((len(a), len(b))) for other, b in blocks]
            for fit, a in blocks
        ]
    )
    sigma = np.sqrt(np.diag(covariance))
    correlation = np.clip(covariance / np.outer(sigma, sigma), -1.0, 1.0)
    correlation = 0.5 * (correlation + correlation.T)

    cameras, places, sigmas, qualities, warnings, end = [], [], [], [], list(doubts), 0
    for c, (fitted, columns) in enumerate(blocks):
        i = fits[c][1]
        camera, T = fitted.bundle.cameras[i], fitted.bundle.T_cam_world[i]
        # The nearest rigid transform: many small steps leave some 1e-15.
        U, _, Vt = np.linalg.svd(T[:3, :3])
        start, end = end, end + len(columns)
        lens, pose = np.split(sigma[start:end], [len(camera.parameters)])
        cameras.append(camera)
        places.append(np.block([[U @ Vt, T[:3, 3:]], [T[3]]]) if fitted is blocks[0][0] else None)
        sigmas.append(CameraSigma(lens, pose if len(pose) else None, correlation[start:end, :end]))
        qualities.append(_quality(views, c, fitted, i))
        focal = float((lens[:2] / camera.intrinsics[:2]).max())
        warnings += _remarks(qualities[-1], focal, placed=places[-1] is not None)
    # Between cameras there are lengths, in one alone none.
    lengths = sum(T is not None for T in places) > 1
    if lengths and board.scale_sigma is None:
        warnings.append(
            "the distance between the cameras is right if the board's squares are as said: measure several in a row on "
            f"the print, and give their length and its sigma: --measured {max(board.shape) - 1} 0.2003 0.0002"
        )
    rig = Rig(tuple(cameras), tuple(places), tuple(sigmas), board.scale_sigma if lengths else None)
    return BoardCalibration(
        board, rig, frozen(covariance), tuple(names), tuple(qualities), tuple(rejected), tuple(warnings)
    )


def _remarks(quality: CameraQuality, focal: float, *, placed: bool) -> list[str]:
    remarks = []
    if focal >= _WORST_FOCAL:
        remarks.append(
            f"camera '{quality.name}': the focal length is known to {100 * focal:.2g} % only (standard deviation): "
            f"refine it with the arm (`estimate: {{intrinsics: refine}}`). {_TILT_THE_BOARD}"
        )
    if len(quality.views) < _FEW_VIEWS:
        what = f"camera '{quality.name}': {len(quality.views)} images are few, 15 to 30 are good"
        remarks.append(f"{what}; the standard deviations are themselves uncertain")
    if quality.coverage < _LEAST_COVERAGE:
        covered = quality.covered
        thirds = {
            "at the left": covered[:, : _GRID[0] // 3], "at the right": covered[:, -(_GRID[0] // 3) :],
            "at the top": covered[: _GRID[1] // 3], "at the bottom": covered[-(_GRID[1] // 3) :],
        }  # fmt: skip
        empty = min(thirds, key=lambda side: float(thirds[side].mean()))
        remarks.append(
            f"camera '{quality.name}': corners lie in {100 * quality.coverage:.0f} % of the image only; the distortion "
            f"of the rest is a guess. Add images with the board {empty}"
        )
    if not placed:
        remarks.append(
            f"camera '{quality.name}' has no view in common with the cameras before it: its place is not known. "
            "Images of the same name must be taken at the same time"
        )
    return remarks
