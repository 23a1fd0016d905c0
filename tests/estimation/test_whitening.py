"""Whitening by factors is whitening: whatever a pose measures, its covariance becomes the identity."""

from __future__ import annotations

import numpy as np
import pytest

from urdfcal.estimation.whitening import JointNoise, Whitening


def covariances(m: int, k: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of four poses: each measurement's own, what the readings do, and both together."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, m, 2, 2))
    own = root @ np.swapaxes(root, 2, 3) + 0.1 * np.eye(2)
    joint = 3.0 * rng.normal(size=(4, 2 * m, k))
    whole = joint @ np.swapaxes(joint, 1, 2)
    for i in range(m):
        whole[:, 2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += own[:, i]
    return own, joint, whole


# Few numbers a pose go by matrices, many by factors; readings may have no noise, or more of it than there are numbers.
@pytest.mark.parametrize(("m", "k"), [(1, 6), (3, 6), (40, 6), (40, 0), (2, 0), (9, 30)])
def test_the_covariance_becomes_the_identity(m: int, k: int) -> None:
    own, joint, whole = covariances(m, k)
    W = Whitening.of(own, joint)
    left = W(whole)
    np.testing.assert_allclose(W(np.swapaxes(left, 1, 2)), np.broadcast_to(np.eye(2 * m), whole.shape), atol=1e-8)
    np.testing.assert_array_equal(W.at(slice(1, 3))(whole[1:3]), left[1:3])


def test_a_single_measurement_has_the_readings_share_of_its_own() -> None:
    m = 5
    own, joint, whole = covariances(m, 6)
    residual = np.random.default_rng(1).normal(size=(4, m, 2))
    norms = JointNoise.of(own, joint).norms(residual)
    for n, i in np.ndindex(4, m):
        block = whole[n, 2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
        r = residual[n, i]
        assert norms[n, i] == pytest.approx(np.sqrt(r @ np.linalg.solve(block, r)))


def test_a_weight_divides_the_measurement_s_own_covariance() -> None:
    own, joint, _ = covariances(3, 2)
    weight = np.full((4, 3), 0.25)
    column = np.ones((4, 6, 1))
    heavier = Whitening.of(4.0 * own, joint)(column)
    np.testing.assert_allclose(JointNoise.of(own, joint).whitening(own, weight)(column), heavier, rtol=1e-12)
