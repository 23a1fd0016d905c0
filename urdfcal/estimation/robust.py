"""Robust weights and outliers by the whitened residual norms of measurements (METHOD 9)."""

from __future__ import annotations

from functools import lru_cache
from math import erfc, exp, gamma, sqrt
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.observations import Observations

Weights: TypeAlias = "Sequence[Floats]"
"""For each kind of measurement (N, m): 1 counts fully, less inflates the covariance by 1 / weight."""

# Shares of whitened residual norms that are longer: the median, what 5 % exceed, and one in a billion. Beyond the
# second a measurement's pull stops growing, which costs clean data less than 5 % efficiency; beyond the third it is an
# outlier: wrong LEDs are tens of standard deviations away, and measured data have honest tails to six (a session of an
# IRB 120).
_MEDIAN, _HUBER, _OUTLIER = 0.5, 0.05, 1e-9
# What an outlier counts: nothing, and the arithmetic stays finite.
REJECTED = 1e-12


@lru_cache
def norm_quantile(dimension: int, tail: float) -> float:
    """Length that a standard normal vector of some dimension exceeds with probability ``tail``.

    The tail of the chi-square distribution in closed form (Abramowitz & Stegun 26.4.4 and 26.4.5), solved by bisection:
    scipy.special would cost every command a fifth of a second.
    """
    low, high = 0.0, 100.0
    while high - low > 1e-15 * high:
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (middle, high) if _tail(dimension, middle**2) > tail else (low, middle)
    return 0.5 * (low + high)


def _tail(dimension: int, x: float) -> float:
    """P(chi^2 > x): Q_1 = erfc(sqrt(x/2)), Q_2 = exp(-x/2), Q_{k+2} = Q_k + (x/2)^(k/2) exp(-x/2) / Gamma(k/2 + 1)."""
    k = 1 if dimension % 2 else 2
    tail = erfc(sqrt(x / 2.0)) if k == 1 else exp(-x / 2.0)
    while k < dimension:
        tail += (x / 2.0) ** (k / 2.0) * exp(-x / 2.0) / gamma(k / 2.0 + 1.0)
        k += 2
    return tail


def unit_weights(observations: Sequence[Observations]) -> Weights:
    """Weigh all measurements fully."""
    return [np.ones(observed.row.shape) for observed in observations]


def keep_weights(observations: Sequence[Observations], norms: Sequence[Floats], weights: Weights) -> Weights:
    """Leave the weights as they are."""
    del observations, norms
    return weights


class HuberWeights:
    """Huber weights in units of the residuals' robust scale.

    Within a descent the scale may only shrink: else one bad step raises it, outliers pull harder, and it rises again.
    """

    def __init__(self) -> None:
        """Start without a scale."""
        self._scales: dict[int, float] = {}

    def __call__(self, observations: Sequence[Observations], norms: Sequence[Floats], weights: Weights) -> Weights:
        """Give measurements beyond the limit the weight limit / norm."""
        del weights
        renewed = []
        for i, (observed, norm) in enumerate(zip(observations, norms, strict=True)):
            self._scales[i] = min(robust_scale(observed, norm), self._scales.get(i, np.inf))
            limit = norm_quantile(observed.dimension, _HUBER) * self._scales[i]
            renewed.append(limit / np.maximum(norm, limit))
        return renewed


def find_outliers(observations: Sequence[Observations], norms: Sequence[Floats]) -> list[Bools]:
    """Find the measurements (N, m) whose whitened residual norm is no noise, in units of its robust scale."""
    return [
        (norm > norm_quantile(observed.dimension, _OUTLIER) * robust_scale(observed, norm)) & observed.valid
        for observed, norm in zip(observations, norms, strict=True)
    ]


def robust_scale(observed: Observations, norm: Floats) -> float:
    """Return how many times longer than the declared noise's the median residual is, at least 1."""
    return max(1.0, float(np.median(norm[observed.valid])) / norm_quantile(observed.dimension, _MEDIAN))
