"""Whitening of measurements by their own noise and that of the joint readings (METHOD 8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.estimation.linearize import Linearization


@dataclass(frozen=True, eq=False)
class JointNoise:
    """What the joint readings' noise does to measurements.

    Attributes:
        joint: (N, mD, mD) covariance of whole poses from joint readings.
        marginal: (N, m, D, D) what gives each measurement alone unit variance, its share of the joint noise included.
    """

    joint: Floats
    marginal: Floats

    @classmethod
    def of(cls, covariance: Floats, joint: Floats) -> JointNoise:
        """Take the covariance (N, m, D, D) of measurements and that of whole poses from joint readings."""
        N, m, D, _ = covariance.shape
        each = np.arange(m)
        own = covariance + np.moveaxis(joint.reshape(N, m, D, m, D)[:, each, :, each, :], 0, 1)
        return cls(joint, np.linalg.inv(np.linalg.cholesky(own)))

    def norms(self, residual: Floats) -> Floats:
        """Return the whitened residual norm (N, m) of each measurement alone."""
        own = (self.marginal @ residual[..., None])[..., 0]
        result: Floats = np.sqrt(np.einsum("nmd,nmd->nm", own, own))
        return result

    def whitening(self, covariance: Floats, weight: Floats) -> Floats:
        """Return what gives the residuals of whole poses unit variance (N, mD, mD).

        Args:
            covariance: (N, m, D, D) of the measurements alone, which is divided by the weight.
            weight: (N, m).
        """
        own = block_diagonal(covariance / weight[..., None, None])
        W: Floats = np.linalg.inv(np.linalg.cholesky(self.joint + own))
        return W


def block_diagonal(covariance: Floats) -> Floats:
    """Return the covariance of whole poses (N, mD, mD) of measurements (N, m, D, D) that err independently."""
    N, m, D, _ = covariance.shape
    each, pose = np.arange(m), np.zeros((N, m, D, m, D))
    pose[:, each, :, each, :] = np.moveaxis(covariance, 1, 0)
    return pose.reshape(N, m * D, m * D)


def joint_covariance(at: Linearization, reading_jacobian: Floats, sigma: float) -> Floats:
    """Return the covariance (N, mD, mD) of whole poses from joint readings of a standard deviation.

    Args:
        at: the derivatives.
        reading_jacobian: (n, k) of all joints by those that are read: a mimic joint errs with its master.
        sigma: of each reading. [rad or m]
    """
    N, m, D = at.residual.shape
    J_q = sigma * (at.J_q.reshape(N * m * D, -1) @ reading_jacobian).reshape(N, m * D, -1)
    covariance: Floats = J_q @ np.swapaxes(J_q, -1, -2)
    return covariance
