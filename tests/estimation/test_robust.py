from __future__ import annotations

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
