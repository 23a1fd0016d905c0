"""Whitening of measurements by their own noise and that of the joint readings (METHOD 8).

The joint readings' noise moves all measurements of a pose together, by as many numbers as there are joints: whatever a
pose measures, its covariance is block diagonal but for a part of that rank, and costs no more than that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.linearize import Linearization

# Poses of so few numbers are whitened by a matrix each, which is quicker than its factors.
_FEW = 16


@dataclass(frozen=True, eq=False)
class JointNoise:
    """What the joint readings' noise does to measurements.

    Attributes:
        joint: (N, m D, k) what one standard deviation of each reading does; k is 0 where they have no noise.
        marginal: (N, m, D, D) what gives each measurement alone unit variance, its share of the joint noise included.
    """

    joint: Floats
    marginal: Floats

    @classmethod
    def of(cls, covariance: Floats, joint: Floats) -> JointNoise:
        """Take the covariance (N, m, D, D) of measurements, and what the joint readings do to whole poses."""
        own = joint.reshape(*covariance.shape[:3], joint.shape[-1])
        return cls(joint, np.linalg.inv(np.linalg.cholesky(covariance + own @ np.swapaxes(own, -1, -2))))

    def at(self, poses: Bools) -> JointNoise:
        """Return that of some of the poses (N,)."""
        return JointNoise(self.joint[poses], self.marginal[poses])

    def norms(self, residual: Floats) -> Floats:
        """Return the whitened residual norm (N, m) of each measurement alone."""
        own = (self.marginal @ residual[..., None])[..., 0]
        result: Floats = np.sqrt(np.einsum("nmd,nmd->nm", own, own))
        return result

    def whitening(self, covariance: Floats, weight: Floats) -> Whitening:
        """Return what gives the residuals of whole poses unit variance.

        Args:
            covariance: (N, m, D, D) of the measurements alone, which is divided by the weight.
            weight: (N, m).
        """
        return Whitening.of(covariance / weight[..., None, None], self.joint)


@dataclass(frozen=True, eq=False)
class Whitening:
    """What gives the numbers of whole poses unit variance: (1 + A A^T)^(-1/2), after each measurement's own factor.

    Attributes:
        own: (N, m, D, D) gives each measurement unit variance by its own noise.
        A: (N, m D, k) what the joint readings do to measurements so whitened.
        strength: (N, k) eigenvalues of A^T A.
        axes: (N, k, k) its eigenvectors.
    """

    own: Floats
    A: Floats
    strength: Floats
    axes: Floats

    @classmethod
    def of(cls, covariance: Floats, joint: Floats) -> Whitening:
        """Take the covariance (N, m, D, D) of measurements, and what the joint readings do (N, m D, k)."""
        own = np.linalg.inv(np.linalg.cholesky(covariance))
        A = _each(own, joint)
        strength, axes = np.linalg.eigh(np.swapaxes(A, 1, 2) @ A)
        return cls(own, A, np.maximum(strength, 0.0), axes)

    def at(self, poses: slice) -> Whitening:
        """Return that of some of the poses."""
        return Whitening(self.own[poses], self.A[poses], self.strength[poses], self.axes[poses])

    def __call__(self, columns: Floats) -> Floats:
        """Whiten columns (N, m D, k)."""
        if columns.shape[1] <= _FEW:
            result: Floats = self._matrix @ columns
            return result
        return self.shared(_each(self.own, columns))

    def shared(self, columns: Floats) -> Floats:
        """Whiten columns (N, m D, k) that are whitened by their measurements' own noise already."""
        if not self.A.shape[2]:
            return columns
        # (1 + A A^T)^(-1/2) = 1 - A V [s (1 + s)]^-1 V^T A^T with s^2 = 1 + strength.
        s = np.sqrt(1.0 + self.strength)[:, None]
        inner = (self.axes / (s * (1.0 + s))) @ np.swapaxes(self.axes, 1, 2)
        result: Floats = columns - self.A @ (inner @ (np.swapaxes(self.A, 1, 2) @ columns))
        return result

    @cached_property
    def _matrix(self) -> Floats:
        N, m, D, _ = self.own.shape
        whole = np.zeros((N, m, D, m, D))
        each = np.arange(m)
        whole[:, each, :, each, :] = np.moveaxis(self.own, 1, 0)
        return self.shared(whole.reshape(N, m * D, m * D))


def joint_noise(at: Linearization, reading_jacobian: Floats, sigma: float) -> Floats:
    """Return what a standard deviation of each joint reading does to whole poses (N, m D, k).

    Args:
        at: the derivatives.
        reading_jacobian: (n, k) of all joints by those that are read: a mimic joint errs with its master.
        sigma: of each reading. [rad or m]
    """
    N, m, D = at.residual.shape
    result: Floats = sigma * (at.J_q.reshape(N * m * D, -1) @ reading_jacobian).reshape(N, m * D, -1)
    return result


def _each(own: Floats, columns: Floats) -> Floats:
    """Multiply the rows of each measurement by its own matrix (N, m, D, D)."""
    N, m, D, _ = own.shape
    result: Floats = (own @ columns.reshape(N, m, D, columns.shape[2])).reshape(columns.shape)
    return result
