"""Corners of squares, where four meet or of one alone, to a hundredth of a pixel, each with its covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Bools, Floats
    from urdfcal.cameras.board.board import Board
    from urdfcal.images.files import Image

# Further out there is little left to learn, and the lens bends the edges.
_REACH = 8
# Share of a square that a corner's window reaches into: the edges of the next corner must not show.
_SHARE = 0.42
# Two-dimensional fits with fewer pixels than this are noise.
_FEWEST_PIXELS = 24
# The detectors are right to about 0.2 px; a fit that walks further has found something else.
_FARTHEST_STEP = 1.5
_MAX_STEPS = 30
_CONVERGED = 1e-4
# Standard deviation at which a fit starts and the range of what it may find, px.
_BLUR, _SHARPEST, _SOFTEST = 0.9, 0.25, 6.0
# How many times smaller soft pictures are looked at, from which blur on (px), or if fewer corners than this are found.
_COARSER, _SOFT, _ENOUGH = (2, 4), 2.5, 0.9
# On a corner the edges explain the window; more of the contrast is left where a highlight or a finger is. Noise alone
# leaves 0.24 at a contrast of 25 grey levels.
_MISFIT = 0.4
# Corners known worse than this, px, tell nothing.
_WORST = 1.0
_SETTLED = 1e-2
_ROUNDING = 1.0 / 12.0


@dataclass(frozen=True, eq=False)
class Corners:
    """What one image shows of a board.

    Attributes:
        uv: (N, 2) px, all inner corners in the board's order; NaN where one was not found.
        covariance: (N, 2, 2) of them, px², from what the fit leaves of the pixels; NaN likewise.
        blur: (N,) standard deviation of the edges' blur, the wider of the two edges, px; NaN likewise.
    """

    uv: Floats
    covariance: Floats
    blur: Floats

    @property
    def found(self) -> Bools:
        """(N,) which corners were found."""
        return np.isfinite(self.uv[:, 0])

    def squares(self, board: Board) -> float:
        """Side of a square in the image, the shorter one, median over the corners, px."""
        return float(np.nanmedian(np.linalg.norm(_squares(board, self.uv), axis=2).min(axis=1)))


def refine(image: Image, board: Board, uv: Floats) -> Corners:
    """Find the corners near ``uv``.

    Around a corner at c the image is ``m + h erf(n1·(x - c) / (√2 s1)) erf(n2·(x - c) / (√2 s2))``, with an
    angle and a blur for either edge. True image and model look the same turned by half around c, whatever the
    blur, the camera's tone curve and the light's level, which leaves no bias to first order.

    Soft pictures are looked at in halves and quarters of their size, too, where a window of the same number of pixels
    reaches further; of a corner the most certain reading counts.

    Args:
        image: (h, w) grey levels.
        board: what is seen.
        uv: (N, 2) px, right to about a pixel and to the blur; NaN where a corner was not seen.
    """
    return _refined(image, uv, partial(_squares, board), partial(_weights, board), 0.0)


def refine_marker(image: Image, uv: Floats, modules: int) -> Corners:
    """Find the four corners of a black marker on white paper near ``uv``.

    As :func:`refine`, with 1 + erf for erf: one of the four quadrants is dark. Their meeting point itself does not
    count: where edges are not at right angles to each other, its blur is no product of theirs.

    Args:
        image: (h, w) grey levels.
        uv: (4, 2) px, right to about a pixel and to the blur, clockwise from the top left.
        modules: along a side, the black border included.
    """
    return _refined(image, uv, _sides, partial(_marker_weights, modules), 1.0)


def _refined(
    image: Image,
    uv: Floats,
    directions: Callable[[Floats], Floats],
    weigh: Callable[[Floats, Floats], Floats],
    lone: float,
) -> Corners:
    """Fit the corners near ``uv`` (N, 2) at the image's own size, and soft ones at smaller sizes.

    Args:
        image: (h, w) grey levels.
        uv: (N, 2). [px]
        directions: gives for corners (N, 2) the directions (N, 2, 2) of their two edges.
        weigh: gives for directions (n, 2, 2) and places (n, K, 2) about a corner the weights (n, K) of pixels.
        lone: 0 where four squares meet, 1 for the corner of one.
    """
    import cv2

    best = _read(image, uv, directions(uv), weigh, lone)
    for factor in _COARSER:
        if best.found.sum() > _ENOUGH * np.isfinite(uv[:, 0]).sum() and np.nanmedian(best.blur) < _SOFT * factor / 2:
            break
        height, width = (side // factor * factor for side in image.shape)
        small = cv2.resize(image[:height, :width], None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
        # The middle of a small pixel is that of the pixels it was made of.
        shift = 0.5 * (factor - 1)
        shrunk = (uv - shift) / factor
        coarse = _read(small, shrunk, directions(shrunk), weigh, lone)
        values = factor * coarse.uv + shift, factor**2 * coarse.covariance, factor * coarse.blur
        better = ~(np.trace(best.covariance, axis1=1, axis2=2) <= np.trace(values[1], axis1=1, axis2=2))
        for ours, theirs in zip((best.uv, best.covariance, best.blur), values, strict=True):
            ours[better] = theirs[better]
    return best


def _read(
    image: Image, uv: Floats, directions: Floats, weigh: Callable[[Floats, Floats], Floats], lone: float
) -> Corners:
    """Fit the corners near ``uv`` at the image's own size."""
    at = np.flatnonzero(np.isfinite(directions).all(axis=(1, 2)))
    height, width = image.shape
    margin = _REACH + 1
    origin = np.rint(uv[at]).astype(int)
    inside = ((origin >= margin) & (origin < np.array([width, height]) - margin)).all(axis=1)
    at, origin = at[inside], origin[inside]
    n = len(uv)
    found = Corners(np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), np.full(n, np.nan))
    offsets = np.stack(np.meshgrid(*[np.arange(-_REACH, _REACH + 1)] * 2), axis=-1).reshape(-1, 2).astype(float)
    weights = weigh(directions[at], offsets - (uv[at] - origin)[:, None])
    enough = weights.sum(axis=1) >= _FEWEST_PIXELS
    at, origin, weights = at[enough], origin[enough], weights[enough]
    if not at.size:
        return found
    pixels = origin[:, None] + offsets.astype(int)
    windows = image[pixels[..., 1], pixels[..., 0]].astype(float)
    parameters, covariance, good = _fit(windows, weights, offsets, uv[at] - origin, directions[at], lone)
    blur = parameters[:, 4:6].max(axis=1)
    good &= np.linalg.norm(parameters[:, :2] - (uv[at] - origin), axis=1) < np.maximum(_FARTHEST_STEP, blur)
    found.uv[at[good]] = origin[good] + parameters[good, :2]
    found.covariance[at[good]] = covariance[good]
    found.blur[at[good]] = blur[good]
    return found


def _squares(board: Board, uv: Floats) -> Floats:
    """(N, 2, 2) how far one square to the right and one down reach in the image, px; NaN if too little is seen.

    From the corner's neighbours rather than a homography, which a fisheye does not obey.
    """
    across, down = board.shape
    grid = np.pad(uv.reshape(down, across, 2), ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    here = grid[1:-1, 1:-1]
    steps = []
    for before, after in ((grid[1:-1, :-2], grid[1:-1, 2:]), (grid[:-2, 1:-1], grid[2:, 1:-1])):
        step = 0.5 * (after - before)
        for alone in (after - here, here - before):
            step = np.where(np.isfinite(step), step, alone)
        steps.append(step)
    return np.stack(steps, axis=-2).reshape(-1, 2, 2)


def _weights(board: Board, directions: Floats, d: Floats) -> Floats:
    """(n, K) which pixels of each window show this corner's two edges and nothing else."""
    ab = np.abs(d @ np.linalg.inv(directions))
    shown = (ab < _SHARE).all(axis=-1) & (np.linalg.norm(d, axis=-1) <= _REACH)
    if board.marker is not None:
        # Markers leave a frame around the edges, in squares; their blur reaches some pixels out of them.
        frame = 0.5 * (1.0 - board.marker / board.square)
        size = np.linalg.norm(directions, axis=2).min(axis=1)[:, None]
        shown &= ab.min(axis=-1) < frame - np.minimum(2.0 * _BLUR / size, 0.5 * frame)
    return np.asarray(shown.astype(float))


def _sides(uv: Floats) -> Floats:
    """(4, 2, 2) the sides of a marker at each corner, along both of which dark lies to the right."""
    return np.stack([np.roll(uv, -1, axis=0) - uv, uv - np.roll(uv, 1, axis=0)], axis=1)


def _marker_weights(modules: int, directions: Floats, d: Floats) -> Floats:
    """(n, K) which pixels of each window show the marker's border and the white around it, and nothing else."""
    inward = d @ np.linalg.inv(directions) * [1.0, -1.0]
    away = np.linalg.norm(d, axis=-1)
    size = np.linalg.norm(directions, axis=2).min(axis=1)[:, None]
    module = np.maximum(1.0 / modules - 2.0 * _BLUR / size, 0.5 / modules)
    shown = (away <= _REACH) & (away > 2.0 * _BLUR)
    shown &= (
        (inward < _SHARE).all(axis=-1) & (inward.min(axis=-1) < module) & (inward > -module[..., None]).all(axis=-1)
    )
    return np.asarray(shown.astype(float))


def _fit(
    windows: Floats, weights: Floats, offsets: Floats, start: Floats, directions: Floats, lone: float
) -> tuple[Floats, Floats, Bools]:
    """Damped Gauss-Newton for all corners at once.

    Returns:
        (n, 8) c (2), angles (2), blurs (2), m, h; (n, 2, 2) covariance of c; and (n,) whether it converged to a corner.
    """
    n = len(windows)
    angles = np.arctan2(directions[..., 1], directions[..., 0])
    p = np.concatenate([start, angles, np.full((n, 2), _BLUR), np.zeros((n, 2))], axis=1)
    # m and h enter linearly.
    shape = _model(p, offsets, lone)[1][..., 7]
    total = weights.sum(axis=1)
    mean, middle = (weights * windows).sum(axis=1) / total, (weights * shape).sum(axis=1) / total
    spread = (weights * (shape - middle[:, None]) ** 2).sum(axis=1)
    p[:, 7] = (weights * (shape - middle[:, None]) * windows).sum(axis=1) / np.maximum(spread, 1e-12)
    p[:, 6] = mean - p[:, 7] * middle

    value, J = _model(p, offsets, lone)
    cost = (weights * (windows - value) ** 2).sum(axis=1)
    damping = np.full(n, 1e-3)
    step = np.full((n, 2), np.inf)
    for _ in range(_MAX_STEPS):
        JtW = np.swapaxes(J * weights[..., None], 1, 2)
        H, g = JtW @ J, (JtW @ (windows - value)[..., None])[..., 0]
        diagonal = np.einsum("nii->ni", H)
        H = H + damping[:, None, None] * np.eye(8) * np.maximum(diagonal, 1e-9)[:, None, :]
        move = np.linalg.solve(H, g[..., None])[..., 0]
        trial = p + move
        trial[:, 4:6] = np.clip(trial[:, 4:6], _SHARPEST, _SOFTEST)
        new_value, new_J = _model(trial, offsets, lone)
        new_cost = (weights * (windows - new_value) ** 2).sum(axis=1)
        better = new_cost <= cost
        p[better], value[better], J[better] = trial[better], new_value[better], new_J[better]
        cost[better] = new_cost[better]
        step[better] = np.abs(move[better, :2])
        damping = np.where(better, damping / 10.0, damping * 10.0)
        if (step.max(axis=1) < _CONVERGED).all():
            break
    H = np.swapaxes(J * weights[..., None], 1, 2) @ J
    H += 1e-12 * np.eye(8) * np.maximum(np.einsum("nii->ni", H), 1e-9)[:, None, :]
    variance = cost / np.maximum(total - 8.0, 1.0)
    # Grey levels are whole: a picture without noise is known to their rounding.
    covariance = np.maximum(variance, _ROUNDING)[:, None, None] * np.linalg.inv(H)[:, :2, :2]
    good = (step.max(axis=1) < _SETTLED) & (np.sqrt(cost / total) < _MISFIT * np.abs(p[:, 7]))
    good &= (p[:, 4:6] < 0.99 * _SOFTEST).all(axis=1) & (np.einsum("nii->n", covariance) < 2.0 * _WORST**2)
    return p, covariance, good


def _model(p: Floats, offsets: Floats, lone: float) -> tuple[Floats, Floats]:
    """The image (n, K) of corners ``p`` (n, 8) and its derivative (n, K, 8)."""
    from scipy.special import erf

    d = offsets - p[:, None, :2]
    sides, slopes, along = [], [], []
    for i in (0, 1):
        c, s = np.cos(p[:, 2 + i, None]), np.sin(p[:, 2 + i, None])
        blur = p[:, 4 + i, None]
        across = (c * d[..., 1] - s * d[..., 0]) / blur
        sides.append(lone + erf(across / np.sqrt(2.0)))
        slopes.append(np.sqrt(2.0 / np.pi) * np.exp(-0.5 * across**2) / blur)
        along.append((across, c * d[..., 0] + s * d[..., 1], c, s))
    shape = sides[0] * sides[1]
    h = p[:, 7, None]
    J = np.zeros((*shape.shape, 8))
    for i in (0, 1):
        across, forward, c, s = along[i]
        slope = h * slopes[i] * sides[1 - i]
        J[..., 0] += slope * s
        J[..., 1] -= slope * c
        J[..., 2 + i] = -slope * forward
        J[..., 4 + i] = -slope * across
    J[..., 6] = 1.0
    J[..., 7] = shape
    return p[:, 6, None] + h * shape, J
