"""Score tests: how much of an estimate's residuals a further effect would explain (METHOD 15)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import one_blas_thread
from urdfcal.estimation.blocks.base_pose import BaseBlock, base_keys
from urdfcal.estimation.blocks.cameras import CameraPoseBlock, LensBlock, camera_poses, camera_values
from urdfcal.estimation.blocks.leds import LEDS, LedsBlock
from urdfcal.estimation.blocks.scale import ScaleBlock
from urdfcal.estimation.blocks.targets import PrintBlock, target_blocks
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.noise import with_noise
from urdfcal.estimation.parameters import Parameters
from urdfcal.estimation.robust import norm_quantile
from urdfcal.estimation.whitening import Whitening, joint_noise
from urdfcal.session.knowledge import Led
from urdfcal.session.target import Target

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.blocks.base import Block
    from urdfcal.estimation.linearize import Linearization
    from urdfcal.estimation.noise import FoundNoise
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution
    from urdfcal.estimation.state import Key, State
    from urdfcal.session.model import Session

# More poses find the same effects, only surer, and cost a pass over all.
_MOST_POSES = 600
# Outliers count with this tail of the noise and no more: one is chance, a row of them from some pose on is no chance.
_BOUNDED = 1e-4
# A direction that the estimate reproduces but for this share of it is the estimate's.
_EXPLAINED = 1e-6
_ALL = slice(None)


@dataclass(frozen=True, eq=False)
class Part:
    """One kind of measurement, its derivatives by everything that may have changed, and its whitening.

    Attributes:
        observed: N poses of m slots of D numbers.
        at: residuals, and derivatives by ``parameters`` and the joint values.
        parameters: base, LEDs, scale, and the pose and lens of every camera, all active.
        W: whitens whole poses.
    """

    observed: Observations
    at: Linearization
    parameters: Parameters
    W: Whitening

    @property
    def pose(self) -> Ints:
        """(N,) index of the session's pose."""
        return self.observed.pose

    def by(self, key: Key[Any], coordinates: slice = _ALL, camera: int | None = None) -> Floats:
        """Return the derivative (N, m D, k) by a block's coordinates.

        Args:
            key: of the block.
            coordinates: some of them.
            camera: whose measurements alone it concerns; of what no camera measured none.
        """
        N, m, D = self.at.residual.shape
        columns = self.at.J[..., self.parameters.columns(key)][..., coordinates].reshape(N, m * D, -1)
        if camera is None:
            return columns
        if "camera" not in self.observed.index:
            return np.zeros_like(columns)
        mine = (self.observed.index["camera"] == camera) & self.observed.valid
        masked: Floats = columns * np.repeat(mine, D, axis=1).reshape(N, m * D, 1)
        return masked

    def by_joint(self, joint: int) -> Floats:
        """Return the derivative (N, m D, 1) by a joint's value."""
        columns: Floats = self.at.J_q[..., joint, None]
        return columns

    def whitened(self, columns: Floats) -> Floats:
        """Return columns (N, m D, k) in standard deviations."""
        return self.W(columns)


@dataclass(frozen=True, eq=False)
class Unexplained:
    """The whitened residuals of an estimate, and what it explains already.

    Attributes:
        problem: what was measured.
        state: the estimate.
        parts: one for each kind of measurement.
        r: (R + P,) whitened residuals, kind by kind and pose by pose, and below them those of the priors; less what the
            parameters still explain of them, as of outliers that had no part in the estimate.
        pose: (R,) the session's pose of each that was measured.
        Q: (R + P, p) orthonormal, spans what the estimate's parameters do to them.
        upper: (p, p) of the QR decomposition: the parameters' steps from what Q carries.
    """

    problem: Problem
    state: State
    parts: tuple[Part, ...]
    r: Floats
    pose: Ints
    Q: Floats
    upper: Floats

    @classmethod
    def of(cls, session: Session, problem: Problem, fit: Solution, noise: Sequence[FoundNoise]) -> Unexplained:
        """Take an estimate, outliers at the edge of the noise.

        Args:
            session: what was measured.
            problem: of its measurements.
            fit: the estimate.
            noise: of each kind of measurement and of the joint readings; what is declared larger than it is found
                counts as found: it would drown what is looked for.
        """
        *less, less_joint = (1.0 / max(of.ratio, 1.0) for of in noise)
        even = [observed.even(_MOST_POSES) for observed in problem.observations]
        thinned = problem.with_observations([of.at(some) for of, some in zip(problem.observations, even, strict=True)])
        everything = _everything(session, fit.state)
        parts, rs, Js, poses = [], [], [], []
        with one_blas_thread():
            covariances = with_noise(thinned.observations, less)
            parts_of = zip(thinned.observations, covariances, even, fit.norms, fit.outlier, strict=True)
            for observed, covariance, some, norm, outlier in parts_of:
                at = Tangent.at(thinned, observed, fit.state, everything).linearise()
                J = Tangent.at(thinned, observed, fit.state, fit.parameters).linearise().J
                sigma, chain = less_joint * thinned.joint_sigma, thinned.mechanism
                joint = joint_noise(at, chain.reading_jacobian, sigma)
                limit = norm_quantile(observed.dimension, _BOUNDED)
                weight = np.where(outlier[some], (limit / np.maximum(norm[some], limit)) ** 2, 1.0)
                W = Whitening.of(covariance / weight[..., None, None], joint)
                part = Part(observed, at, everything, W)
                N, m, D = at.residual.shape
                rs.append(part.whitened(at.residual.reshape(N, m * D, 1)).ravel())
                Js.append(part.whitened(J.reshape(N, m * D, -1)).reshape(N * m * D, -1))
                poses.append(np.repeat(observed.pose, m * D))
                parts.append(part)
            r_prior, J_prior = fit.parameters.prior_residuals(fit.state)
            J = np.vstack([*Js, J_prior])
            scale = column_scale(J)
            r = np.concatenate([*rs, r_prior])
            Q, upper = np.linalg.qr(J / scale)
            r -= Q @ (Q.T @ r)
        return cls(thinned, fit.state, tuple(parts), r, np.concatenate(poses), Q, upper * scale)

    def columns(self, effect: Callable[[Part], Floats]) -> Floats:
        """Return the whitened columns (R + P, k) of an effect that gives (N, m D, k) for each kind of measurement."""
        found = [part.whitened(effect(part)) for part in self.parts]
        columns = np.vstack([of.reshape(-1, of.shape[-1]) for of in found])
        return np.vstack([columns, np.zeros((len(self.r) - len(columns), columns.shape[1]))])

    @cached_property
    def total(self) -> float:
        """The sum of squares that is to be explained."""
        return float(self.r @ self.r)

    @cached_property
    def freedom(self) -> float:
        """Degrees of freedom of that sum: measured numbers and priors less parameters.

        Repeats of a configuration share its errors, and count once.
        """
        measured = sum(part.observed.count * part.observed.dimension for part in self.parts)
        freedom = max(1, measured + len(self.r) - len(self.pose) - self.Q.shape[1])
        poses = np.unique(self.pose)
        return float(freedom * len(np.unique(self.problem.readings.unit[poses])) / len(poses))

    def explained(self, columns: Floats) -> tuple[float, Floats, Floats]:
        """Test an effect of columns (R + P, k).

        Returns:
            By how much the sum of squares would fall, the effect's size (k,) and its covariance (k, k) for noise as
            declared.
        """
        scale = column_scale(columns)
        B = columns / scale
        gram = B.T @ B - (self.Q.T @ B).T @ (self.Q.T @ B)
        return solve_score(gram, B.T @ self.r, scale)

    def response(self, column: Floats, fixed: slice) -> Floats:
        """Return how the estimate's parameters (p,) answer to an effect of one column (R + P, 1) that is not modelled.

        Some of them are fixed, and answer nothing.
        """
        p = len(self.upper)
        free = np.ones(p, dtype=bool)
        free[fixed] = False
        answer = np.zeros(p)
        answer[free] = -np.linalg.lstsq(self.upper[:, free], self.Q[:, :p].T @ column, rcond=None)[0][:, 0]
        return answer

    def less(self, columns: Floats) -> Unexplained:
        """Return what is left once an effect of columns (R + P, k) is explained."""
        B = columns / column_scale(columns)
        B = B - self.Q @ (self.Q.T @ B)
        U, s, _ = np.linalg.svd(B, full_matrices=False)
        U = U[:, s > _EXPLAINED]
        return replace(self, r=self.r - U @ (U.T @ self.r), Q=np.hstack([self.Q, U]))


def column_scale(columns: Floats) -> Floats:
    """Return the lengths of columns (R, k), 1 for those that are zero."""
    length = np.linalg.norm(columns, axis=0)
    return np.where(length > 0.0, length, 1.0)


def solve_score(gram: Floats, score: Floats, scale: Floats) -> tuple[float, Floats, Floats]:
    """Solve the normal equations of an effect whose scaled columns have a Gram matrix and a product with residuals."""
    values, vectors = np.linalg.eigh(gram)
    good = values > _EXPLAINED
    along = vectors[:, good]
    size = -(along @ ((along.T @ score) / values[good])) / scale
    gain = float(np.sum((along.T @ score) ** 2 / values[good]))
    return gain, size, (along / values[good]) @ along.T / np.outer(scale, scale)


def _everything(session: Session, state: State) -> Parameters:
    """Base, LEDs, targets and their prints, scale, and the pose and the lens of every camera, all of them free."""
    leds = [Led(led.name) for led in session.leds]
    blocks: list[Block[Any]] = [BaseBlock.of(fixed=None, key=key) for key in base_keys(session.parts)]
    blocks.append(LedsBlock.of(leds, state[LEDS], priors=False))
    blocks += target_blocks([Target(of.name, of.pattern) for of in session.targets], state, priors=False)
    blocks += [PrintBlock.of(of) for of in session.targets if of.point_names]
    blocks.append(ScaleBlock.of(np.inf))
    attachments, free = session.attachments, np.full(6, np.inf)
    lenses, poses = camera_values(attachments, state), camera_poses(attachments, state)
    blocks += [CameraPoseBlock.of(lens.name, T, free) for lens, T in zip(lenses, poses, strict=True)]
    own = (lens for c, lens in enumerate(lenses) if attachments.lens[c] == c)
    blocks += [LensBlock.of(lens, np.full(len(lens.parameters), np.inf)) for lens in own]
    size = sum(len(block) for block in blocks)
    return Parameters(tuple(blocks), np.eye(size), np.zeros(size, dtype=bool))
