"""Derivatives of measurements by all unknowns, from the motions of links (METHOD 5)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.base_pose import base_keys
from urdfcal.estimation.blocks.targets import target_key
from urdfcal.estimation.links import Links
from urdfcal.estimation.measurements.point_geometry import carry
from urdfcal.robot.kinematics import joint_axes, link_motions

if TYPE_CHECKING:
    import pinocchio as pin

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Parameters
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.state import Key, State
    from urdfcal.robot.kinematics import LinkMotion

_EVERY = slice(None)
# Newton's method on a pose that is a centimetre off arrives in four steps at 1e-12; beside a singularity it does not.
_NEWTON, _ZERO, _SINGULAR = 8, 1e-11, 1e-2


class Jacobian:
    """The derivative of K = N m measurements of D numbers by the active parameters, filled block by block."""

    def __init__(self, parameters: Parameters, count: int, dimension: int) -> None:
        """Start with zeros (count, dimension, active parameters)."""
        self._parameters = parameters
        self.values = np.zeros((count, dimension, parameters.count))

    def wants(self, key: Key[Any]) -> bool:
        """Return whether a coordinate of a block is active."""
        return self._parameters.has_active(key)

    def put(self, key: Key[Any], derivative: Floats, rows: Ints | slice = _EVERY) -> None:
        """Add the derivative (K or len(rows), D, k) by the k coordinates of a block; fixed ones are left out."""
        if not self.wants(key):
            return
        where, active = self._parameters.active_columns(key)
        self.values[rows, :, where] += derivative if active.all() else derivative[..., active]


@dataclass(frozen=True, eq=False)
class Linearization:
    """Residuals of some poses and their derivatives; zero where a slot is padding.

    Attributes:
        residual: (N, m, D) predicted minus measured.
        J: (N, m, D, count) derivative by the active parameters.
        by_frame: derivatives by the motions of the world and of links, see ``ByFrame``.
        motions: of the links among these frames; where slots are taken at times of their own, of N m poses.
        axes: (6 n, n) body twists of the joints' motions.
    """

    residual: Floats
    J: Floats
    by_frame: tuple[Floats | None, ...]
    motions: tuple[LinkMotion, ...]
    axes: Floats

    @cached_property
    def J_q(self) -> Floats:
        """(N, m D, n) derivative by the joint values."""
        N, m, D = self.residual.shape
        count, n = len(self.motions[0].R), self.axes.shape[1]
        each = _by_placements(self.by_frame, self.motions, self.axes, (count, N * m * D // count, n))
        return each.reshape(N, m * D, n)


@dataclass(frozen=True, eq=False)
class Tangent:
    """Everything about a state that its derivatives share over the poses: prepared once, evaluated part by part.

    Attributes:
        problem: what is predicted.
        observed: what was measured.
        state: where to linearise.
        parameters: the derivative's columns.
        model: of the arm at the state.
        G: (6 n, p) body twists of the placements for each of the arm's active parameters.
        q: (N, n) joint values at the state; (N m, n) where slots are taken at times of their own. [rad or m]
    """

    problem: Problem
    observed: Observations
    state: State
    parameters: Parameters
    model: pin.Model
    G: Floats
    q: Floats

    @classmethod
    def at(cls, problem: Problem, observed: Observations, state: State, parameters: Parameters) -> Tangent:
        """Prepare."""
        return cls(
            problem,
            observed,
            state,
            parameters,
            problem.mechanism.build_model(problem.placements(state)),
            problem.twists(state[ARM], parameters.arm_rows),
            problem.joint_values(observed.by_slot.readings, state),
        )

    def linearise(self, poses: slice = _EVERY) -> Linearization:
        """Evaluate residuals and derivatives for some of the observations' N poses."""
        problem, state, parameters = self.problem, self.state, self.parameters
        observed = self.observed if poses == _EVERY else self.observed.at(poses)
        shape, observed = observed.value.shape, observed.by_slot
        N, m, D = observed.value.shape
        q = self.q.reshape(len(self.observed.row), -1, self.q.shape[1])[poses].reshape(-1, self.q.shape[1])
        motions = link_motions(problem.mechanism, self.model, q, problem.attachments.tips)
        part = observed.readings.part
        links = Links.of(problem.attachments, state, part, [of.R for of in motions], [of.p for of in motions])
        J = Jacobian(parameters, N * m, D)
        at = observed.table.linearise(observed, links, state, J)
        residual = np.where(observed.valid[..., None], at.predicted - observed.value, 0.0)
        by_frame = _carried(at.by_frame, links, J, (N * m, D))
        world = by_frame[0]
        if world is not None:  # the base moves in the world as the world does against it
            by_base, keys = -world.reshape(N * m, D, 6), base_keys(problem.attachments.parts)
            for k, key in enumerate(keys):
                rows = _EVERY if len(keys) == 1 else np.flatnonzero(np.repeat(part == k, m))
                J.put(key, by_base[rows], rows)
        if self.G.shape[1]:
            by_arm = _by_placements(by_frame, motions, self.G, (N, m * D, self.G.shape[1]))
            J.values[:, :, parameters.active_columns(ARM)[0]] = by_arm.reshape(N * m, D, -1)
        axes = joint_axes(problem.mechanism)
        found = Linearization(residual.reshape(shape), J.values.reshape(*shape, -1), by_frame, motions, axes)
        for model in problem.joint_models:
            if J.wants(model.key):
                by_model = model.jacobian(observed.readings, state[model.key])
                J.put(model.key, (found.J_q.reshape(N, m * D, -1) @ by_model).reshape(N * m, D, -1))
        return found


def _carried(
    by_frame: tuple[Floats | None, ...], links: Links, J: Jacobian, shape: tuple[int, int]
) -> tuple[Floats | None, ...]:
    """Pass derivatives by the motions of targets on to their poses, and to the motions of what carries them.

    With its carrier's velocity (v, w) a target's origin, a lever arm r off, moves by v + w x r.

    Args:
        by_frame: for each frame (N, m D, 6) or None.
        links: where the frames are.
        J: takes the derivatives by the targets' poses.
        shape: (N m, D).

    Returns:
        The same for the world and the links alone.
    """
    first = links.attachments.first_target
    result = list(by_frame[:first])
    for k, (name, carrier) in enumerate(links.attachments.carried, first):
        values = by_frame[k]
        if values is None:
            continue
        own = np.concatenate([values[..., :3] @ links.R[k], values[..., 3:] @ links.R[k]], axis=-1)
        J.put(target_key(name), own.reshape(*shape, 6))
        lever = links.p[k] if carrier == 0 else links.p[k] - links.p[carrier]
        values = values + np.concatenate(
            [np.zeros_like(values[..., :3]), np.cross(lever[:, None], values[..., :3])], axis=-1
        )
        before = result[carrier]
        result[carrier] = values if before is None else before + values
    return tuple(result)


def _by_placements(
    by_frame: tuple[Floats | None, ...], motions: tuple[LinkMotion, ...], G: Floats, shape: tuple[int, int, int]
) -> Floats:
    """Derivative (N, m D, p) by what moves the placements as G (6 n, p)."""
    parts = [
        values @ carry(motion.regressor, G)
        for values, motion in zip(by_frame[1:], motions, strict=True)
        if values is not None
    ]
    return sum(parts[1:], start=parts[0]) if parts else np.zeros(shape)


def fulfilled(problem: Problem, observed: Observations, state: State, parameters: Parameters) -> Observations:
    """Move joint readings to where the arm, as a state has it, does what was observed; other poses are left out.

    That something is zero, as a ball's distance from its socket, stays true however all turn together, but a residual
    turns along, and its derivative would look like information. Newton's method, with the shortest step of each pose.
    """
    moved = problem.mechanism.reading_jacobian
    for _ in range(_NEWTON):
        at = Tangent.at(problem, observed, state, parameters).linearise()
        r, J = at.residual.reshape(len(at.residual), -1, 1), at.J_q @ moved
        done = np.abs(r[..., 0]).max(axis=1) < _ZERO
        if done.all():
            break
        q = observed.readings.q - (np.linalg.pinv(J, rcond=_SINGULAR) @ r)[..., 0] @ moved.T
        observed = replace(observed, readings=replace(observed.readings, q=q))
    return observed.at(done) if done.any() else observed
