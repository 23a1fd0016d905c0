"""Uncertainty of the calibrated tip over the workspace (METHOD 12)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import covariance_of, rms
from urdfcal.estimation.alignment import kabsch
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.joint_models import Readings
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.robot.flexure import spread_placements
from urdfcal.robot.kinematics import joint_axes, link_motions, tip_poses
from urdfcal.rotations import skew
from urdfcal.session.trajectory import AT_REST

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.estimation.parameters import Parameters
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution
    from urdfcal.estimation.state import State
    from urdfcal.robot.mechanism import Tip

# Configurations that stand for the workspace when the base is aligned.
_WORKSPACE = 300
# Draws of an estimate: percentiles to a few per cent.
_DRAWS = 2000


@dataclass(frozen=True)
class SizeError:
    """The part of the tip's expected error that is one factor of all the arm's lengths.

    Attributes:
        sigma: standard deviation of that factor. [1]
        rms: what it does to the tip over the workspace, the bases aligned. [m]
        rms_without: the tip's expected error if the factor were known. [m]
    """

    sigma: float
    rms: float
    rms_without: float


def tip_covariance(problem: Problem, fit: Solution, q: Floats, seed: int = 0, tip: Tip | None = None) -> Floats:
    """Compute the covariance of the calibrated tip's position in the base link's frame.

    The covariance of the arm's offsets carried to the tip, less what a best rigid alignment over the workspace takes
    away: how a robot is bolted down is nothing its URDF could know. The tip's place on the last link counts as nominal.

    Args:
        problem: the arm and its joint models.
        fit: the estimate.
        q: (N, n) joint values. [rad or m]
        seed: of the configurations that stand for the workspace.
        tip: another link than the first tip.

    Returns:
        (N, 3, 3). [m^2]
    """
    _, alignment = _aligned(problem, fit, seed, tip)
    A, rigid = _motion(problem, fit.state, fit.parameters, np.asarray(q, dtype=float), tip)
    A = A - rigid @ alignment
    result: Floats = A @ fit.covariance @ np.swapaxes(A, 1, 2)
    return result


def tip_change(problem: Problem, fit: Solution, step: Floats, seed: int = 0, tip: Tip | None = None) -> float:
    """Compute by how much the calibrated tip moves over the workspace, rms after the best alignment, in metres.

    Args:
        problem: the arm and its joint models.
        fit: the estimate.
        step: (count,) of its active parameters.
        seed: of the configurations that stand for the workspace.
        tip: another link than the first tip.
    """
    A = aligned_motion(problem, fit, seed, tip)
    return float(np.sqrt(np.sum((A @ step) ** 2) / _WORKSPACE))


def tip_error(
    problem: Problem, fit: Solution, seed: int = 0, tip: Tip | None = None
) -> tuple[float, tuple[float, float]]:
    """Compute what rms error of the calibrated tip over the workspace is to be expected, if the model holds.

    The estimate's covariance carried to the tip, after the best alignment at the base; the interval is that of the rms
    of estimates drawn from the covariance. Its spread over regions left out, and over other joint models, is what may
    be wrong, not what is: it raises the upper end alone, but where the residuals exceed the noise (:func:`expecting`).

    Args:
        problem: the arm and its joint models.
        fit: the estimate.
        seed: of the configurations and the draws.
        tip: another link than the first tip.

    Returns:
        The expected rms, and its 95 % interval. [m]
    """
    A = aligned_motion(problem, fit, seed, tip)
    gram = np.einsum("nij,nik->jk", A, A) / _WORKSPACE
    normal = np.random.default_rng(seed).standard_normal((_DRAWS, len(gram))) ** 2
    expected, low, high = np.zeros((3, len(gram)))
    for of, strengths in ((expecting(fit), expected), (replace(fit, spread=None, doubt=None), low), (fit, high)):
        values, vectors = np.linalg.eigh(of.covariance)  # without priors it may be singular to rounding
        factor = vectors * np.sqrt(np.maximum(values, 0.0))
        strengths[:] = np.maximum(np.linalg.eigvalsh(factor.T @ gram @ factor), 0.0)
    ends = [float(np.percentile(np.sqrt(normal @ of), at)) for of, at in ((low, 2.5), (high, 97.5))]
    return float(np.sqrt(np.sum(expected))), (ends[0], ends[1])


def expecting(fit: Solution) -> Solution:
    """Return an estimate whose covariance is what is to be expected of it, and not what may be wrong as well.

    Where nothing exceeds the noise, that is the noise: of pandas that sag and lag, with eccentric encoders, the tip is
    0.17 mm off, 0.16 is expected by noise, and 0.30 with what left-out regions differ by.
    """
    return fit if fit.misfit else replace(fit, spread=None, doubt=None)


def size_error(problem: Problem, fit: Solution, seed: int = 0) -> SizeError:
    """Compute how much of the tip's expected error is a common factor of all lengths, and what is left without.

    An arm that is too long by one factor moves its tip away from the workspace's middle by that share of the distance:
    the factor is the tip's displacement projected on that field. It is uncorrelated with what a rigid alignment takes.

    Args:
        problem: the arm and its joint models.
        fit: the estimate.
        seed: of the configurations.
    """
    A = aligned_motion(problem, fit, seed)
    workspace = problem.arm.chain.random_values(_WORKSPACE, np.random.default_rng(seed))
    field = tip_poses(problem.arm.chain, workspace, problem.arm.placements(problem.offsets(fit.state)))[:, :3, 3]
    field = field - field.mean(axis=0)
    squares = float(np.sum(field**2))
    factor = np.einsum("nik,ni->k", A, field) / squares
    with_factor = fit.covariance @ factor
    variance = float(max(factor @ with_factor, 0.0))
    known = fit.covariance - (np.outer(with_factor, with_factor) / variance if variance > 0.0 else 0.0)
    left = float(np.einsum("nij,jk,nik->", A, known, A, optimize=True))
    return SizeError(
        variance**0.5, (variance * squares / _WORKSPACE) ** 0.5, float(np.sqrt(max(left, 0.0) / _WORKSPACE))
    )


def tip_rms_with(problem: Problem, fit: Solution, factor: float, seed: int = 0) -> float:
    """Compute what rms error of the tip would be expected over the workspace if more were measured of the same kind.

    Args:
        problem: the arm and its joint models.
        fit: the estimate.
        factor: how many times as much as there is.
        seed: of the configurations.

    Returns:
        The expected rms, if the model holds. [m]
    """
    _, J = fit.parameters.prior_residuals(fit.state)
    priors = J.T @ J
    A = aligned_motion(problem, fit, seed).reshape(-1, fit.parameters.count)
    covariance = covariance_of(priors + factor * (fit.information - priors))
    return float(np.sqrt(max(np.sum((A @ covariance) * A), 0.0) / _WORKSPACE))


def aligned_motion(problem: Problem, fit: Solution, seed: int = 0, tip: Tip | None = None) -> Floats:
    """Compute how the tip moves over the workspace with the active parameters, the base aligned as well as can be.

    Args:
        problem: the arm and its joint models.
        fit: the estimate.
        seed: of the configurations.
        tip: another link than the first tip.

    Returns:
        (N, 3, count) derivative at N configurations. [m per unit of the parameter]
    """
    return _aligned(problem, fit, seed, tip)[0]


def tip_sensitivity(problem: Problem, state: State, parameters: Parameters, q: Floats) -> Floats:
    """Compute how the tip moves with the active parameters, less what a best alignment of the base takes away.

    Args:
        problem: the arm and its joint models.
        state: where to linearise.
        parameters: the derivative's columns.
        q: (N, n) joint values over which the base is aligned. [rad or m]

    Returns:
        (N, 3, count) derivative of the tip's position. [m per unit of the parameter]
    """
    return _less_alignment(*_motion(problem, state, parameters, q))[0]


def rigid_loss(problem: Problem, state: State) -> float:
    """Compute how far the tip of the rigid arm is off from that of the estimate at the session's poses.

    Args:
        problem: the arm, its joint models and the session's readings.
        state: the estimate.

    Returns:
        The rms distance after the best alignment: what a URDF cannot hold of the joint models. [m]
    """
    chain, placements = problem.mechanism, problem.placements(state)
    bent = [model for model in problem.joint_models if isinstance(model, LinearJointModel)]
    rigid = state.replace({model.key: model.nominal for model in bent})
    joints = (problem.joint_values(problem.readings, of) for of in (rigid, state))
    here, true = (tip_poses(chain, q, placements)[:, :3, 3] for q in joints)
    T = kabsch(here, true)
    return rms(np.linalg.norm(here @ T[:3, :3].T + T[:3, 3] - true, axis=1))


def _aligned(problem: Problem, fit: Solution, seed: int, tip: Tip | None = None) -> tuple[Floats, Floats]:
    """How the tip moves over the workspace with the active parameters (N, 3, count), the base aligned (6, count)."""
    workspace = problem.arm.chain.random_values(_WORKSPACE, np.random.default_rng(seed))
    return _less_alignment(*_motion(problem, fit.state, fit.parameters, workspace, tip))


def _less_alignment(A: Floats, rigid: Floats) -> tuple[Floats, Floats]:
    """Take from the tip's motion (N, 3, count) what the base's does (N, 3, 6), which is returned too, (6, count)."""
    alignment = np.asarray(np.linalg.lstsq(rigid.reshape(-1, 6), A.reshape(-1, A.shape[2]), rcond=None)[0])
    return A - rigid @ alignment, alignment


def _motion(
    problem: Problem, state: State, parameters: Parameters, q: Floats, tip: Tip | None = None
) -> tuple[Floats, Floats]:
    """How the tip moves with the active parameters (N, 3, count), and with the base as a rigid body (N, 3, 6)."""
    arm, offsets = problem.arm, problem.offsets(state)
    chain, q = problem.mechanism, problem.told(q)
    model = chain.build_model(spread_placements(chain, arm.placements(offsets)))
    (motion,) = link_motions(chain, model, q, [chain.tips[0] if tip is None else chain.tip(tip.link)])
    A = np.zeros((len(q), 3, parameters.count))
    A[..., parameters.active_columns(ARM)[0]] = (motion.regressor @ problem.twists(offsets, parameters.arm_rows))[:, :3]
    J_q = (motion.regressor @ joint_axes(chain))[:, :3]
    # Where an arm comes from, and torques that only a measurement tells, are as good as any.
    torques = problem.readings.torques
    if torques is not None:
        torques = torques[np.arange(len(q)) % len(torques)]
    part = np.zeros(len(q), dtype=np.intp)
    readings = Readings(q, np.arange(len(q)), AT_REST, part, torques, np.roll(q, 1, axis=0))
    for model in problem.joint_models:
        where, active = parameters.active_columns(model.key)
        if where.stop > where.start:
            A[..., where] = (J_q @ model.jacobian(readings, state[model.key]))[..., active]
    rigid = np.concatenate([np.broadcast_to(np.eye(3), (len(q), 3, 3)), -skew(motion.p)], axis=2)
    return A, rigid
