"""Lens models: where on the normalised image plane a lens puts a ray, and the way back.

Both models bend a plane vector ``w`` by the same polynomial,

    distorted(w) = g(|w|²) w + |w|² p + 2 (p·w) w,    g(s) = 1 + k1 s + k2 s² + ...,    p = (p2, p1),

with ``w = (x, y) = (X/Z, Y/Z)`` for radtan (Brown-Conrady, as in OpenCV and Kalibr), and with
``w = atan(r)/r (x, y)``, p = 0 for equidistant (Kannala-Brandt, the fisheye of OpenCV and Kalibr). It is the
gradient of a potential, so its derivative J is symmetric, and on a disc where J is positive definite it is
one-to-one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen

if TYPE_CHECKING:
    from collections.abc import Mapping

# Coefficients in the order of the files; radtan's k3 may be left out.
COEFFICIENTS: Mapping[str, tuple[str, ...]] = {
    "radtan": ("k1", "k2", "p1", "p2", "k3"),
    "equidistant": ("k1", "k2", "k3", "k4"),
    "none": (),
}
# Lengths of the coefficient vector each model takes.
LENGTHS: Mapping[str, tuple[int, ...]] = {"radtan": (4, 5), "equidistant": (4,), "none": (0,)}

# |(x, y)| = 1000 is 89.94° off the optical axis: beyond any pinhole image, and r⁶ is still far from overflow.
_FARTHEST = 1e3
# At the fold J is singular. 0.1 % short of it its smallest eigenvalue is about 2e-3, and Newton still works.
_SHORT_OF_FOLD = 0.999
# Newton takes 4 to 6 steps on real lenses; some 53 halvings are needed to give up on an unreachable pixel.
_MAX_STEPS = 80
# Residual on the normalised plane; rounding leaves some 1e-16, 1e-13 is 1e-9 px at f = 10000 px.
_CONVERGED = 1e-13


@dataclass(frozen=True, eq=False)
class Lens:
    """One lens model with its coefficients and the disc on which it is one-to-one.

    Attributes:
        fisheye: w is the angle from the axis (equidistant) rather than its tangent.
        radial: (K,) coefficients of s, s², ... in g(s).
        decentring: (2,) the vector p = (p2, p1); zero for equidistant.
        order: index of every coefficient in the file's order into (radial..., p1, p2).
        limit: largest |w| the lens is used at, short of the fold, where larger angles turn back inwards.
    """

    fisheye: bool
    radial: Floats
    decentring: Floats
    order: tuple[int, ...]
    limit: float

    @classmethod
    def from_coefficients(cls, model: str, coefficients: Floats) -> Lens:
        """Build the lens ``model`` from ``coefficients`` (k,), both already checked."""
        if model == "radtan":
            k1, k2, p1, p2 = coefficients[:4]
            radial = np.array([k1, k2, *coefficients[4:]])
            decentring = np.array([p2, p1])
            order = (0, 1, len(radial), len(radial) + 1, *range(2, len(radial)))
        else:
            radial, decentring = coefficients, np.zeros(2)
            order = tuple(range(len(radial)))
        fisheye = model == "equidistant"
        farthest = float(np.arctan(_FARTHEST)) if fisheye else _FARTHEST
        limit = min(farthest, _SHORT_OF_FOLD * _fold_radius(radial, float(np.hypot(*decentring))))
        return cls(fisheye, frozen(radial), frozen(decentring), order, limit)

    @property
    def radius(self) -> float:
        """Largest |(x, y)| the lens is used at (the tangent of the angle from the optical axis)."""
        return min(float(np.tan(self.limit)), _FARTHEST) if self.fisheye else self.limit

    def distort(self, xy: Floats) -> Floats:
        """Distorted plane coordinates of ``xy`` (..., 2), which must lie within :attr:`radius`."""
        return self._bend(self._flatten(xy)[0])[0]

    def distort_with_jacobian(self, xy: Floats) -> tuple[Floats, Floats]:
        """:meth:`distort` and its derivative wrt ``xy``: (..., 2) and (..., 2, 2)."""
        w, scale, growth = self._flatten(xy)
        distorted, J = self._bend(w)
        if not self.fisheye:
            return distorted, J
        J_w = growth[..., None, None] * (xy[..., :, None] * xy[..., None, :])
        J_w[..., 0, 0] += scale
        J_w[..., 1, 1] += scale
        return distorted, J @ J_w

    def coefficient_jacobian(self, xy: Floats) -> Floats:
        """Derivative of :meth:`distort` wrt the coefficients in the file's order: (..., 2) -> (..., 2, k)."""
        w = self._flatten(xy)[0]
        s = np.sum(w * w, axis=-1, keepdims=True)
        radial = [w * s ** (i + 1) for i in range(len(self.radial))]
        p1 = 2.0 * w[..., 1:] * w + s * np.array([0.0, 1.0])
        p2 = 2.0 * w[..., :1] * w + s * np.array([1.0, 0.0])
        columns = [*radial, p1, p2]
        return np.stack([columns[i] for i in self.order], axis=-1) if self.order else np.zeros((*xy.shape, 0))

    def undistort(self, distorted: Floats) -> Floats:
        """Inverse of :meth:`distort`, (..., 2) -> (..., 2); NaN where no ray within the disc is seen there.

        Newton's method with the analytic J; a step that leaves the disc or does not come closer is halved.
        As the map is the gradient of a convex potential there, this finds the one solution if there is one.
        """
        target = distorted.reshape(-1, 2)
        w = np.full_like(target, np.nan)
        active = np.flatnonzero(np.isfinite(target).all(axis=1))
        goal = target[active]
        size = np.linalg.norm(goal, axis=1, keepdims=True)
        w[active] = start = goal * np.minimum(1.0, 0.9 * self.limit / np.maximum(size, 1e-300))
        value, J = self._bend(start)
        error = goal - value
        step = _solve(J, error)
        missed = np.full(len(target), np.inf)
        missed[active] = np.linalg.norm(error, axis=1)
        for _ in range(_MAX_STEPS):
            # Rounding has been reached where a step no longer moves the point.
            moving = np.abs(step).max(axis=1, initial=0.0) > 1e-16 * (1.0 + np.abs(w[active]).max(axis=1, initial=0.0))
            active, step = active[moving], step[moving]
            if not active.size:
                break
            trial = w[active] + step
            inside = np.sum(trial * trial, axis=1) <= self.limit**2
            trial[~inside] = 0.0
            value, J = self._bend(trial)
            error = target[active] - value
            distance = np.linalg.norm(error, axis=1)
            closer = inside & (distance < missed[active])
            w[active[closer]] = trial[closer]
            missed[active[closer]] = distance[closer]
            step = np.where(closer[:, None], _solve(J, error), 0.5 * step)
        size = np.linalg.norm(target, axis=1)
        w[~(missed <= _CONVERGED * (1.0 + size))] = np.nan
        if self.fisheye:
            angle = np.maximum(np.hypot(w[:, :1], w[:, 1:]), 1e-15)
            w *= np.tan(angle) / angle
        return w.reshape(distorted.shape)

    def _flatten(self, xy: Floats) -> tuple[Floats, Floats, Floats]:
        """w(xy), with the two factors of its derivative: dw/dxy = scale·1 + growth·xy xyᵀ."""
        if not self.fisheye:
            return xy, np.ones(()), np.zeros(())
        # atan(r)/r is 1 to the last bit for r < 1e-9, so this only keeps 0/0 away.
        r2 = np.maximum(np.sum(xy * xy, axis=-1), 1e-30)
        r = np.sqrt(r2)
        scale = np.arctan(r) / r
        return xy * scale[..., None], scale, (1.0 / (1.0 + r2) - scale) / r2

    def _bend(self, w: Floats) -> tuple[Floats, Floats]:
        """The polynomial of the module's head at ``w`` (..., 2) and its symmetric derivative (..., 2, 2)."""
        x, y = w[..., 0], w[..., 1]
        s = x * x + y * y
        g, slope = np.zeros_like(s), np.zeros_like(s)
        for k in self.radial[::-1]:
            slope = slope * s + g
            g = g * s + k
        # Horner gave h(s) = k1 + k2 s + ... and h'(s); g = 1 + s h.
        g, slope = 1.0 + s * g, g + s * slope
        px, py = self.decentring
        pull = 2.0 * (px * x + py * y)
        distorted = np.stack([(g + pull) * x + px * s, (g + pull) * y + py * s], axis=-1)
        J = np.empty((*s.shape, 2, 2))
        J[..., 0, 0] = g + pull + 2.0 * slope * x * x + 4.0 * px * x
        J[..., 1, 1] = g + pull + 2.0 * slope * y * y + 4.0 * py * y
        J[..., 0, 1] = J[..., 1, 0] = 2.0 * (slope * x * y + py * x + px * y)
        return distorted, J


def _fold_radius(radial: Floats, decentring: float) -> float:
    """Radius of the disc around the axis on which J is positive definite; infinite when it is everywhere.

    With f(r) = r g(r²) and P = |p|, J in polar coordinates (c, s = cosine and sine of the angle to p) is
    [[f' + 6Prc, -2Prs], [-2Prs, g + 2Prc]]. It is positive definite in every direction if f' > 6Pr and
    3g > 10Pr: the first is exact opposite to p, the second never bites on a lens one would buy.
    """
    powers = np.arange(1, len(radial) + 1)
    smallest = np.inf
    for scale, weights, pull in ((1.0, (2 * powers + 1) * radial, 6.0), (3.0, 3.0 * radial, 10.0)):
        # Both are polynomials in r with a non-zero constant. In 1/r the highest coefficient is that
        # constant, so vanishing distortion coefficients are no special case; the fold is the largest root.
        polynomial = np.zeros(2 * len(radial) + 2)
        polynomial[0] = scale
        polynomial[1] = -pull * decentring
        polynomial[2::2] = weights
        roots = np.roots(polynomial)
        real = roots.real[(roots.real > 0.0) & (np.abs(roots.imag) <= 1e-6 * np.abs(roots.real))]
        if real.size:
            smallest = min(smallest, 1.0 / float(real.max()))
    return smallest


def _solve(J: Floats, b: Floats) -> Floats:
    """Solve symmetric positive definite 2x2 systems, (..., 2, 2) and (..., 2) -> (..., 2)."""
    xx, xy, yy = J[..., 0, 0], J[..., 0, 1], J[..., 1, 1]
    determinant = xx * yy - xy * xy
    solved = np.stack([yy * b[..., 0] - xy * b[..., 1], xx * b[..., 1] - xy * b[..., 0]], axis=-1)
    return np.asarray(solved / determinant[..., None])
