"""Where a spot of light is in its crop, how well that is known, and how much it looks like a spot at all."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.detection.spots import gaussian
from urdfcal.detection.spots.gaussian import L11, L12, L22, LEVEL, PEAK, Rows, U, V, Windows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from urdfcal.arrays import Bools, Floats, Ints

# Crops reach this far from the brightest pixel: four widths of a spot of 5.5 px.
HALF = 24
# Fitted within these windows, the smallest that holds what matters: the time goes with their area.
_HALVES = np.array([7, 10, 15, HALF])
# Windows reach four widths and two pixels: a wider one gains less than 2 % in accuracy (sigma 1 to 3 px, slope
# unknown), and lets in more neighbours.
_WIDTHS, _MARGIN = 4.0, 2.0
# The core is what is brighter than a tenth of the peak: it tells shot noise and shape; the wings, below 2 %, the noise.
_CORE, _WINGS = 0.1, 0.02
# Rounding alone: no image has less noise.
_LEAST_VARIANCE = 1.0 / 12.0
# Pixels that a spot cannot explain (hot ones, another light's rim) are left out of the last fit.
_OUTLYING = 6.0
# What tells of shot noise: no hot pixel, which is narrower than this [px], and nothing that leaves over several
# times what others do, which is not noise.
_LIKE_A_SPOT, _UNUSUAL = 0.5, 5.0
# A pixel whose neighbours have less than this share of its light, and which is this many deviations bright, shines
# by itself: of a spot 0.4 px wide they have 13 % at least, and 25 % of one 0.5 px wide.
_SHARED, _BRIGHT = 0.12, 12.0
# From the middle of a crop. [px]
_DISTANCE = np.hypot(np.arange(-HALF, HALF + 1), np.arange(-HALF, HALF + 1)[:, None])
# Fits at a time: 64 of the largest windows and their derivatives are 11 MB.
_BATCH = 64


@dataclass(frozen=True, eq=False)
class Crops(Rows):
    """Squares of (2 HALF + 1)² pixels around n candidates.

    Attributes:
        centre: (n, 2) pixel (u, v) in the middle of each.
        values: (n, side, side) counts.
        usable: (n, side, side) False outside the image.
        saturated: (n, side, side) pixels at the end of the range.
    """

    centre: Ints
    values: NDArray[np.float32]
    usable: Bools
    saturated: Bools


@dataclass(frozen=True, eq=False)
class Fits(Rows):
    """What n crops hold.

    Attributes:
        uv: (n, 2) centre. [px]
        sigma: (n,) standard deviation of u and of v. [px]
        peak: (n,) of the light, extrapolated where saturated. [counts]
        width: (n,) geometric mean of the spot's two standard deviations, the pixel's own taken off. [px]
        ratio: (n,) of the longer to the shorter one at least, less two standard deviations.
        significance: (n,) peak over its own standard deviation.
        misfit: (n,) rms of what the spot leaves unexplained of its core beyond noise, as a share of the peak.
        lobe: (n,) the brightest thing beside the spot in its window, as a share of the peak; 0 if it may be noise.
        saturated: (n,) number of saturated pixels.
        found: (n,) the fit converged.
    """

    uv: Floats
    sigma: Floats
    peak: Floats
    width: Floats
    ratio: Floats
    significance: Floats
    misfit: Floats
    lobe: Floats
    saturated: Ints
    found: Bools

    @property
    def flux(self) -> Floats:
        """(n,) brightness: the volume under the spot."""
        return np.asarray(2.0 * np.pi * self.peak * (self.width**2 + 1.0 / 12.0))

    @classmethod
    def unknown(cls, places: Ints) -> Fits:
        """Lights at pixels ``places`` (n, 2) that were not measured."""
        nothing = {f.name: np.full(len(places), np.nan) for f in fields(cls)[1:]}
        nothing |= {"found": np.zeros(len(places), dtype=bool), "saturated": np.zeros(len(places), dtype=np.intp)}
        return cls(places.astype(np.float64), **nothing)


def fit_spots(crops: Crops, width: float | None = None) -> Fits:
    """Fit a spot to each crop.

    How noise grows with light is not known of a camera: it is taken from what the first fits leave over in the
    spots' cores, of all crops together, which should therefore come from one camera.

    Args:
        crops: each with a spot within three pixels of its middle.
        width: of the spots, where it is known: what is farther away than its wings is then not looked at. [px]
    """
    if not len(crops):
        return Fits.unknown(crops.centre)
    crops = replace(crops, usable=crops.usable & ~_lonely(crops))
    if width is not None:
        crops = replace(crops, usable=crops.usable & (_WIDTHS * width + _MARGIN >= _DISTANCE))
    first = _start(crops) if width is None else _start_with(crops, width)
    half = _HALVES[np.searchsorted(_HALVES[:-1], np.ceil(_WIDTHS * _widths(first).max(axis=1) + _MARGIN))]
    alike = [np.flatnonzero(half == h) for h in _HALVES]
    groups = [rows[i : i + _BATCH] for rows in alike for i in range(0, len(rows), _BATCH)]
    rough = [_Rough.of(crops[rows], int(half[rows[0]]), first[rows]) for rows in groups]
    shot = _shot_noise(rough)
    fits = Rows.join([part.refined(shot) for part in rough])[np.argsort(np.concatenate(groups))]
    fits.uv[:] += crops.centre
    return fits


def _lonely(crops: Crops) -> Bools:
    """Pixels (n, side, side) that shine by themselves: their eight neighbours show next to nothing of it."""
    some = crops.values[:, ::4, ::4]
    level = np.median(some, axis=(1, 2))
    deviation = np.maximum(1.48 * np.median(np.abs(some - level[:, None, None]), axis=(1, 2)), 0.5)
    lonely = np.zeros(crops.values.shape, dtype=bool)
    # Few pixels are bright: only those are compared with their neighbours.
    bright = crops.values > (level + _BRIGHT * deviation)[:, None, None]
    n, v, u = np.nonzero(bright[:, 1:-1, 1:-1])
    v, u = v + 1, u + 1
    shifts = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]
    around = np.max([crops.values[n, v + a, u + b] for a, b in shifts], axis=0)
    lonely[n, v, u] = around - level[n] < _SHARED * (crops.values[n, v, u] - level[n])
    return lonely


@dataclass(frozen=True, eq=False)
class _Rough:
    """Crops fitted without knowing how their noise grows with the light, and the noise (n,) of their background."""

    windows: Windows
    spots: Floats
    covariances: Floats
    converged: Bools
    floor: Floats
    shot: Floats

    @classmethod
    def of(cls, crops: Crops, half: int, spots: Floats) -> _Rough:
        cut = slice(HALF - half, HALF + half + 1)
        axis = np.arange(-half, half + 1, dtype=np.float64)
        pixels: list[NDArray[Any]] = [crops.values, crops.usable, crops.saturated]
        values, usable, saturated = (of[:, cut, cut].reshape(len(crops), -1) for of in pixels)
        u, v = np.tile(axis, axis.size), np.repeat(axis, axis.size)
        windows = Windows(u, v, values.astype(np.float64), usable, saturated)
        floor = np.maximum(_rim_variance(windows), _LEAST_VARIANCE)
        # A first guess: as if the brightest pixel had ten times the background's variance.
        shot = 9.0 * floor / np.maximum(spots[:, PEAK], 1e-9)
        variance = gaussian.pixel_variance(floor, shot, gaussian.light(windows, spots))
        spots, covariances, converged = gaussian.fit(windows, spots, variance)
        reach = _WIDTHS * _widths(spots).max(axis=1) + _MARGIN
        distance = (u - spots[:, U, None]) ** 2 + (v - spots[:, V, None]) ** 2
        near = replace(windows, usable=windows.usable & (distance <= reach[:, None] ** 2))
        glow, r, plain = _explained(near, spots)
        wings = plain & (glow < _WINGS * spots[:, PEAK, None])
        counted = wings.sum(axis=1)
        spread = np.sum(r * r * wings, axis=1) / np.maximum(counted - 3, 1)
        floor = np.where(counted > 20, np.maximum(spread, _LEAST_VARIANCE), floor)
        return cls(near, spots, covariances, converged, floor, shot)

    def shot_evidence(self) -> tuple[Floats, Floats]:
        """For each spot, sums whose ratio is its shot noise per count: what is left in the core against its light."""
        spots = self.spots
        glow, r, plain = _explained(self.windows, spots)
        variance = gaussian.pixel_variance(self.floor, self.shot, glow)
        _, J = gaussian.jacobian(self.windows, spots)
        # The share of each pixel's noise that the fit takes up is not left over.
        hat = np.einsum("nip,nij,njp->np", J, self.covariances, J, optimize=True)
        free = 1.0 - np.clip(hat / variance, 0.0, 0.99)
        weight = (plain & (glow > _CORE * spots[:, PEAK, None])) * (free / variance) ** 2
        left = r * r / free - self.floor[:, None]
        return np.sum(weight * left * glow, axis=1), np.sum(weight * glow * glow, axis=1)

    def refined(self, shot: float) -> Fits:
        """Fit again with the noise that is now known, without what is no spot's, and judge by all that there is."""
        windows, spots = self.windows, self.spots
        glow, r, plain = _explained(windows, spots)
        variance = gaussian.pixel_variance(self.floor, shot, glow)
        z = r / np.sqrt(variance)
        core = plain & (glow > _CORE * spots[:, PEAK, None])
        # A spot that is not quite Gaussian leaves more than noise everywhere in its core.
        usual = np.ma.median(np.ma.array(np.abs(z), mask=~core), axis=1).filled(0.0)  # type: ignore[no-untyped-call]
        limit = _OUTLYING * np.maximum(1.48 * usual, 1.0)
        clean = replace(windows, usable=windows.usable & (windows.saturated | (np.abs(z) <= limit[:, None])))
        spots, covariances, converged = gaussian.fit(clean, spots, variance)
        peak = spots[:, PEAK]
        glow, r, _ = _explained(windows, spots)
        variance = gaussian.pixel_variance(self.floor, shot, glow)
        plain = clean.usable & ~clean.saturated
        z2 = np.sum(np.where(plain, r * r / variance, 0.0), axis=1)
        chi2 = z2 / np.maximum(plain.sum(axis=1) - gaussian.COUNT, 1)
        sigma2 = (covariances[:, U, U] + covariances[:, V, V]) / 2.0 * np.maximum(chi2, 1.0)
        core = plain & (glow > _CORE * peak[:, None])
        beyond = np.sum(np.where(core, r * r - variance, 0.0), axis=1) / np.maximum(core.sum(axis=1), 1)
        widths = np.sqrt(np.maximum(_widths(spots) ** 2 - gaussian.PIXEL_VARIANCE, 1e-4))
        # The deviation of the ratio of axes is that of a nearly round spot: of (l11 - l22, l12) relative to l.
        scale = np.sqrt(np.abs(spots[:, L11] * spots[:, L22]))
        spread = covariances[:, L11, L11] + covariances[:, L22, L22] - 2.0 * covariances[:, L11, L22]
        ratio_sigma = np.sqrt(np.maximum(spread, covariances[:, L12, L12])) / np.maximum(scale, 1e-9)
        return Fits(
            uv=spots[:, [U, V]].copy(),
            sigma=np.sqrt(sigma2),
            peak=peak,
            width=np.sqrt(widths.prod(axis=1)),
            ratio=widths.max(axis=1) / widths.min(axis=1) - 2.0 * ratio_sigma,
            significance=peak / np.sqrt(covariances[:, PEAK, PEAK]),
            misfit=np.sqrt(np.maximum(beyond, 0.0)) / np.maximum(peak, 1e-9),
            lobe=_lobes(windows, r, variance) / np.maximum(peak, 1e-9),
            saturated=(windows.saturated & windows.usable).sum(axis=1),
            found=converged & self.converged & np.isfinite(sigma2),
        )


def _explained(windows: Windows, spots: Floats) -> tuple[Floats, Floats, Bools]:
    """(n, P) the spots' light, what they leave over, and which pixels tell how much that is."""
    glow = gaussian.light(windows, spots)
    return glow, gaussian.residuals(windows, spots, glow), windows.usable & ~windows.saturated


def _shot_noise(rough: list[_Rough]) -> float:
    """Variance per count of light, common to all spots that look like one."""
    above, below = (np.concatenate(sums) for sums in zip(*(part.shot_evidence() for part in rough), strict=True))
    widths = np.concatenate([_widths(part.spots) for part in rough])
    good = np.concatenate([part.converged for part in rough]) & (below > 0.0)
    good &= (widths[:, 0] > _LIKE_A_SPOT) & (widths[:, 1] < 1.5 * widths[:, 0])
    if not good.any():
        return 0.0
    above, below = above[good], below[good]
    usual = max(float(np.median(above / below)), 0.0)
    good = above <= _UNUSUAL * usual * below
    return max(float(above[good].sum() / below[good].sum()), 0.0) if good.any() else usual


def _start(crops: Crops) -> Floats:
    """Spots (n, 9) to start from: the brightest place near the middle, and the area above half its height."""
    clipped = (crops.saturated & crops.usable).any(axis=(1, 2))
    values = np.where(crops.usable, crops.values, np.nan)
    axis = np.arange(-HALF, HALF + 1)
    rim = np.maximum(np.abs(axis), np.abs(axis)[:, None]) >= HALF - 2
    near = np.hypot(axis, axis[:, None]) <= HALF / 2
    spots = np.zeros((len(crops), gaussian.COUNT))
    level = np.nanmedian(values[:, rim], axis=1)
    smooth = _smoothed(np.where(crops.usable, values, level[:, None, None])) - level[:, None, None]
    middle = smooth[:, HALF - 3 : HALF + 4, HALF - 3 : HALF + 4]
    height = np.maximum(middle.max(axis=(1, 2)), 1e-3)
    bright = np.where((smooth > 0.5 * height[:, None, None]) & near, smooth, 0.0)
    area = np.maximum((bright > 0.0).sum(axis=(1, 2)), 1)
    # Compression leaves squares without anything in them: their middle is as good a place as any.
    total = np.maximum(bright.sum(axis=(1, 2)), 1e-9)
    spots[:, U] = np.sum(bright * axis, axis=(1, 2)) / total
    spots[:, V] = np.sum(bright * axis[:, None], axis=(1, 2)) / total
    # Half the height is at 1.18 sigma; the 3 x 3 average adds 2/3 px².
    sigma = np.sqrt(np.clip(area / (2.0 * np.pi * np.log(2.0)) - 2.0 / 3.0, 0.5, 60.0))
    spots[:, PEAK] = height * (1.0 + 2.0 / (3.0 * sigma**2)) * np.where(clipped, 1.5, 1.0)
    spots[:, L11] = spots[:, L22] = np.where(clipped, 1.3, 1.0) / np.sqrt(sigma**2 + gaussian.PIXEL_VARIANCE)
    spots[:, LEVEL] = level
    return spots


def _start_with(crops: Crops, width: float) -> Floats:
    """Spots (n, 9) of a width to start from, at the brightest place near the middle."""
    spots = np.zeros((len(crops), gaussian.COUNT))
    values = np.where(crops.usable, crops.values, np.nan)
    level = np.nanmedian(values, axis=(1, 2))
    smooth = _smoothed(np.where(crops.usable, values, level[:, None, None])) - level[:, None, None]
    middle = smooth[:, HALF - 3 : HALF + 4, HALF - 3 : HALF + 4].reshape(len(crops), 49)
    top = middle.argmax(axis=1)
    spots[:, U], spots[:, V] = top % 7 - 3, top // 7 - 3
    spots[:, PEAK] = np.maximum(middle.max(axis=1), 1e-3) * (1.0 + 2.0 / (3.0 * width**2))
    spots[:, L11] = spots[:, L22] = 1.0 / np.sqrt(width**2 + gaussian.PIXEL_VARIANCE)
    spots[:, LEVEL] = level
    return spots


def _widths(spots: Floats) -> Floats:
    """(n, 2) standard deviations along the two axes of the ellipse in px, longer last."""
    # The singular values of [[l11, l12], [0, l22]], inverted.
    square = spots[:, L11] ** 2 + spots[:, L12] ** 2 + spots[:, L22] ** 2
    product = np.abs(spots[:, L11] * spots[:, L22])
    root = np.sqrt(np.maximum(square**2 - 4.0 * product**2, 0.0))
    largest = np.sqrt((square + root) / 2.0)
    return np.asarray(np.stack([1.0 / largest, largest / product], axis=1))


def _rim_variance(windows: Windows) -> Floats:
    """Variance of the pixels along the edge of each window, from the differences of neighbours, robustly."""
    side = round(np.sqrt(windows.u.size))
    values = windows.values.reshape(-1, side, side)
    usable = windows.usable.reshape(-1, side, side)
    steps = np.concatenate([np.diff(values[:, k], axis=1) for k in (0, 1, -2, -1)], axis=1)
    both = np.concatenate([usable[:, k, 1:] & usable[:, k, :-1] for k in (0, 1, -2, -1)], axis=1)
    spread = np.sum(np.abs(steps) * both, axis=1) / np.maximum(both.sum(axis=1), 1)
    # The mean of |N(0, 2 v)| is sqrt(4 v / pi).
    return np.asarray(np.pi / 4.0 * spread**2)


def _smoothed(images: Floats) -> Floats:
    """Means over 3 x 3 pixels of (n, side, side), the rim repeated."""
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1)), mode="edge")
    rows = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
    return np.asarray((rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:]) / 9.0)


def _lobes(windows: Windows, r: Floats, variance: Floats) -> Floats:
    """The brightest 3 x 3 mean of what is left over, in counts; zero where noise could be it."""
    side = round(np.sqrt(windows.u.size))
    shape = (-1, side, side)
    plain = (windows.usable & ~windows.saturated).reshape(shape)
    left = _smoothed(np.where(plain, r.reshape(shape), 0.0))
    noise = np.sqrt(_smoothed(np.where(plain, variance.reshape(shape), 0.0)) / 9.0)
    loud = np.where(left > _OUTLYING * np.maximum(noise, 1e-9), left, 0.0)
    return np.asarray(loud.max(axis=(1, 2)))
