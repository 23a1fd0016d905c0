"""A Gaussian spot on a sloping background, fitted to many crops at once.

A pixel integrates the light that falls on it. To a Gaussian that adds the variance of the pixel's square, 1/12 px²;
what remains of the difference is its fourth cumulant, -1/120 px⁴, which is symmetric about the centre and so cannot
move it. A spot is therefore a point-sampled Gaussian here, and 1/12 is taken off its variances in the end.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from typing_extensions import Self

    from urdfcal.arrays import Bools, Floats, Ints

_Rows = TypeVar("_Rows", bound="Rows")

PIXEL_VARIANCE = 1.0 / 12.0
# Columns of the parameters: centre, peak, the triangle L of u = L d (density exp(-|u|²/2)), background and slopes.
U, V, PEAK, L11, L12, L22, LEVEL, SLOPE_U, SLOPE_V = range(9)
COUNT = 9

# Clean spots take 4 to 8 steps; those whose peak is not seen, 150 and 1000 times saturated, up to 30 and 50. What still
# walks after 60 (streaks, edges, noise) is no spot.
_MAX_STEPS = 60
# A step that moves the centre by less than 2 % of its standard deviation is the last.
_CONVERGED = 0.02
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-3, 1e6
# What is zero of a round spot: l11 - l22, and l12.
_STRETCH, _SKEW = np.eye(COUNT)[L11] - np.eye(COUNT)[L22], np.eye(COUNT)[L12]
# Spots are round within this much of their width, before it is known better: at a peak of 6 sigma and a width of
# 1 px it keeps one spot in twelve from collapsing onto a single pixel; brighter ones do not notice it.
_ROUND = 0.3
# A pixel's own square has a standard deviation of 0.29: nothing is narrower. Windows are narrower than 1 / 0.02.
_NARROWEST, _WIDEST = 0.27, 40.0


class Rows:
    """A dataclass of arrays with a row for each of n things; a field with a default is of all together."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]

    def __getitem__(self, rows: Ints | Bools) -> Self:
        return self._with(lambda name: getattr(self, name)[rows])

    @staticmethod
    def join(parts: Sequence[_Rows]) -> _Rows:
        """All rows of several, one at least, in order."""

        def joined(name: str) -> Any:
            values = [getattr(part, name) for part in parts]
            return Rows.join(values) if isinstance(values[0], Rows) else np.concatenate(values)

        return parts[0]._with(joined)

    def _with(self, values: Callable[[str], Any]) -> Self:
        rows = [field.name for field in fields(self) if field.default_factory is MISSING]  # type: ignore[arg-type]
        return replace(self, **{name: values(name) for name in rows})  # type: ignore[type-var]


@dataclass(frozen=True, eq=False)
class Windows:
    """Square windows of n images, P pixels each.

    Attributes:
        u, v: (P,) pixel coordinates relative to the window's centre.
        values: (n, P) counts.
        usable: (n, P) pixels that are to be explained.
        saturated: (n, P) pixels that only say "at least this much".
    """

    u: Floats
    v: Floats
    values: Floats
    usable: Bools
    saturated: Bools

    def __getitem__(self, rows: Ints | Bools | slice) -> Windows:
        return Windows(self.u, self.v, self.values[rows], self.usable[rows], self.saturated[rows])


def pixel_variance(floor: Floats, shot: Floats | float, light: Floats) -> Floats:
    """Variance (n, P) of pixels, in counts²: constant, and proportional to the light that the spot adds to it.

    Args:
        floor: (n,) of the background. [counts²]
        shot: (n,) per count of light, or one for all. [counts]
        light: (n, P) counts of the spot on them.
    """
    return np.asarray(floor[:, None] + np.reshape(shot, (-1, 1)) * np.maximum(light, 0.0))


def light(windows: Windows, spots: Floats) -> Floats:
    """Counts (n, P) that ``spots`` (n, 9) add to the background."""
    du, dv = windows.u - spots[:, U, None], windows.v - spots[:, V, None]
    a, b = spots[:, L11, None] * du + spots[:, L12, None] * dv, spots[:, L22, None] * dv
    return np.asarray(spots[:, PEAK, None] * np.exp(-0.5 * (a * a + b * b)))


def residuals(windows: Windows, spots: Floats, glow: Floats | None = None) -> Floats:
    """Measured minus expected counts (n, P); zero where a saturated pixel is expected to be, or none counts."""
    glow = light(windows, spots) if glow is None else glow
    expected = glow + spots[:, LEVEL, None] + spots[:, SLOPE_U, None] * windows.u + spots[:, SLOPE_V, None] * windows.v
    r = windows.values - expected
    r[~windows.usable | (windows.saturated & (r < 0.0))] = 0.0
    return r


def jacobian(windows: Windows, spots: Floats) -> tuple[Floats, Floats]:
    """Light (n, P) and derivatives (n, 9, P) of the expected counts; zero where a pixel says nothing."""
    du, dv = windows.u - spots[:, U, None], windows.v - spots[:, V, None]
    l11, l12, l22 = spots[:, L11, None], spots[:, L12, None], spots[:, L22, None]
    a, b = l11 * du + l12 * dv, l22 * dv
    shape = np.exp(-0.5 * (a * a + b * b))
    glow = spots[:, PEAK, None] * shape
    J = np.empty((len(spots), COUNT, windows.u.size))
    J[:, U] = glow * a * l11
    J[:, V] = glow * (a * l12 + b * l22)
    J[:, PEAK] = shape
    J[:, L11] = -glow * a * du
    J[:, L12] = -glow * a * dv
    J[:, L22] = -glow * b * dv
    J[:, LEVEL] = 1.0
    J[:, SLOPE_U] = windows.u
    J[:, SLOPE_V] = windows.v
    return glow, J


def fit(windows: Windows, spots: Floats, variance: Floats) -> tuple[Floats, Floats, Bools]:
    """Least squares weighted by the pixels' variances, saturated pixels one-sided: damped Gauss-Newton.

    With the variances of a spot near the solution this is as good as maximum likelihood; letting them follow the
    spot during the iteration makes one in six faint ones (peak 6 sigma) oscillate.

    Args:
        windows: n of them.
        spots: (n, 9) to start from.
        variance: (n, P) of the pixels. [counts²]

    Returns:
        Spots (n, 9), their covariances (n, 9, 9), the inverse Fisher information, and which (n,) have converged.
    """
    spots = spots.copy()
    stiffness = (_ROUND * (spots[:, L11] + spots[:, L22]) / 2.0) ** -2
    H, gradient, cost = _linearise(windows, spots, variance, stiffness)
    damping = np.full(len(spots), _FIRST_DAMPING)
    converged = np.zeros(len(spots), dtype=bool)
    active = np.arange(len(spots))
    for _ in range(_MAX_STEPS):
        if not active.size:
            break
        scaled, scale = _scaled(H[active], damping[active])
        step = np.linalg.solve(scaled, (gradient[active] * scale)[..., None])[..., 0] * scale
        trial = spots[active] + step
        trial_H, trial_gradient, trial_cost = _linearise(windows[active], trial, variance[active], stiffness[active])
        # A spot is as wide as a pixel at least, and not endless.
        l11, l12, l22 = trial[:, [L11, L12, L22]].T
        possible = (np.minimum(l11, l22) > 1.0 / _WIDEST) & (trial[:, PEAK] > 0.0)
        possible &= np.maximum(np.hypot(l11, l12), l22) < 1.0 / _NARROWEST
        better = possible & (trial_cost <= cost[active])
        # The step's length in the metric of the information: squared, how many standard deviations it goes.
        gain = np.sum(step * gradient[active], axis=1)
        rows = active[better]
        spots[rows] = trial[better]
        H[rows], gradient[rows], cost[rows] = trial_H[better], trial_gradient[better], trial_cost[better]
        damping[active] = np.where(better, 0.2 * damping[active], 10.0 * damping[active])
        done = better & (gain < _CONVERGED**2)
        converged[active[done]] = True
        active = active[~done & (damping[active] < _LARGEST_DAMPING)]
    # What the information matrices do not tell gets a huge variance.
    scaled, scale = _scaled(H, np.zeros(len(H)))
    return spots, np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :], converged


def _linearise(windows: Windows, spots: Floats, variance: Floats, stiffness: Floats) -> tuple[Floats, Floats, Floats]:
    """Fisher information (n, 9, 9), gradient (n, 9) and cost (n,)."""
    glow, J = jacobian(windows, spots)
    r = residuals(windows, spots, glow)
    # A saturated pixel speaks only where less is expected of it than it showed.
    weight = (windows.usable & (~windows.saturated | (r > 0.0))) / variance
    JW = J * weight[:, None]
    H, gradient, cost = JW @ np.swapaxes(J, 1, 2), (JW @ r[..., None])[..., 0], np.sum(weight * r * r, axis=1)
    for out_of_round in (_STRETCH, _SKEW):
        excess = spots @ out_of_round
        H += stiffness[:, None, None] * np.outer(out_of_round, out_of_round)
        gradient -= (stiffness * excess)[:, None] * out_of_round
        cost += stiffness * excess**2
    return H, gradient, cost


def _scaled(H: Floats, damping: Floats) -> tuple[Floats, Floats]:
    """Matrices (n, 9, 9) scaled to ones on their diagonals, which are then raised a little, and the scales (n, 9)."""
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->ni", H), 1e-30))
    raised = (damping[:, None] + 1e-12)[..., None] * np.eye(COUNT)
    return H * scale[:, :, None] * scale[:, None, :] + raised, scale
