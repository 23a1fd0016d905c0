from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

from urdfcal.estimation import robust


@pytest.mark.parametrize("dimension", [1, 2, 3, 4, 5, 6])
def test_the_quantiles_of_norms_are_those_of_chi_square(dimension: int) -> None:
    for tail in (robust._MEDIAN, robust._HUBER, robust._OUTLIER):
        expected = np.sqrt(chi2.isf(tail, dimension))
        assert robust.norm_quantile(dimension, tail) == pytest.approx(expected, rel=1e-12)
    assert (robust._MEDIAN, robust._HUBER, robust._OUTLIER) == (0.5, 0.05, 1e-9)


def observed_of(count: int, dimension: int = 2) -> SimpleNamespace:
    return SimpleNamespace(dimension=dimension, valid=np.ones((count, 1), bool), row=np.zeros((count, 1), int))


def norms_of(count: int, scale: float, seed: int = 0) -> np.ndarray:
    """Norms (count, 1) of whitened residuals whose noise is ``scale`` times the declared one."""
    return scale * np.linalg.norm(np.random.default_rng(seed).normal(size=(count, 1, 2)), axis=-1)


def test_the_scale_is_the_noises_but_never_less_than_the_declared_one() -> None:
    for scale, expected in ((0.01, 1.0), (0.5, 1.0), (3.0, 3.0)):
        assert robust.robust_scale(observed_of(2000), norms_of(2000, scale)) == pytest.approx(expected, rel=0.05)


def test_small_residuals_have_no_outliers_within_the_declared_noise() -> None:
    # A fit of few poses, or noise declared too large: a tenth of it, and one residual of twice the declared noise.
    norms = norms_of(100, 0.1)
    norms[7] = 2.0
    (outlier,) = robust.find_outliers([observed_of(100)], [norms])
    assert not outlier.any()
    norms[7] = 2.0 * robust.norm_quantile(2, robust._OUTLIER)
    (outlier,) = robust.find_outliers([observed_of(100)], [norms])
    assert np.flatnonzero(outlier).tolist() == [7]
    (weights,) = robust.HuberWeights()([observed_of(100)], [norms], [])
    assert np.all(weights[norms < robust.norm_quantile(2, robust._HUBER)] == 1.0)
    assert weights[7, 0] == pytest.approx(robust.norm_quantile(2, robust._HUBER) / norms[7, 0])


def test_outliers_are_judged_by_the_noise_that_is_there() -> None:
    norms = norms_of(500, 4.0)
    limit = robust.norm_quantile(2, robust._OUTLIER)
    norms[7] = 2.0 * limit
    (outlier,) = robust.find_outliers([observed_of(500)], [norms])
    assert not outlier.any()
    padding = observed_of(500)
    padding.valid[7] = False
    norms[[7, 8]] = 100.0 * limit
    (outlier,) = robust.find_outliers([padding], [norms])
    assert np.flatnonzero(outlier).tolist() == [8]


def test_within_a_descent_the_scale_only_shrinks() -> None:
    weigh, limit = robust.HuberWeights(), robust.norm_quantile(2, robust._HUBER)
    observed = [observed_of(500)]
    (first,) = weigh(observed, [norms_of(500, 3.0)], [])
    (worse,) = weigh(observed, [norms_of(500, 9.0)], [])
    (better,) = weigh(observed, [norms_of(500, 2.0)], [])
    assert first.min() > worse.min()
    scale = robust.robust_scale(observed[0], norms_of(500, 3.0))
    np.testing.assert_allclose(worse, np.minimum(1.0, limit * scale / norms_of(500, 9.0)))
    np.testing.assert_allclose(better.min(), limit * 2.0 / norms_of(500, 2.0).max(), rtol=0.1)
