"""Derivatives of measurements by all unknowns, from the motions of links (METHOD 5)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.base_pose import base_keys
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
        """Write the derivative (K or len(rows), D, k) by the k coordinates of a block; fixed ones are left out."""
        if not self.wants(key):
            return
        where, active = self._parameters.active_columns(key)
        self.values[rows, :, where] = derivative if active.all() else derivative[..., active]


@dataclass(frozen=True, eq=False)
class Linearization:
    """Residuals of some poses and their derivatives; zero where a slot is padding.

    Attributes:
        residual: (N, m, D) predicted minus measured.
        J: (N, m, D, count) derivative by the active parameters.
        by_frame: derivatives by the motions of the frames, see ``ByFrame``.
        motions: of the links among these frames.
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
        return _by_placements(self.by_frame, self.motions, self.axes, (N, m * D, self.axes.shape[1]))


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
        q: (N, n) joint values at the state. [rad or m]
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
        arm, offsets = problem.arm, state[ARM]
        return cls(
            problem,
            observed,
            state,
            parameters,
            arm.chain.build_model(arm.placements(offsets)),
            arm.twists(offsets, parameters.arm_rows),
            problem.joint_values(observed.readings, state),
        )

    def linearise(self, poses: slice = _EVERY) -> Linearization:
        """Evaluate residuals and derivatives for some of the observations' N poses."""
        problem, state, parameters = self.problem, self.state, self.parameters
        observed = self.observed if poses == _EVERY else self.observed.at(poses)
        N, m, D = observed.value.shape
        motions = link_motions(problem.arm.chain, self.model, self.q[poses], problem.attachments.tips)
        part = observed.readings.part
        links = Links.of(problem.attachments, state, part, [of.R for of in motions], [of.p for of in motions])
        J = Jacobian(parameters, N * m, D)
        at = observed.table.linearise(observed, links, state, J)
        residual = np.where(observed.valid[..., None], at.predicted - observed.value, 0.0)
        world = at.by_frame[0]
        if world is not None:  # the base moves in the world as the world does against it
            by_base, keys = -world.reshape(N * m, D, 6), base_keys(problem.attachments.parts)
            for k, key in enumerate(keys):
                rows = _EVERY if len(keys) == 1 else np.flatnonzero(np.repeat(part == k, m))
                J.put(key, by_base[rows], rows)
        if self.G.shape[1]:
            by_arm = _by_placements(at.by_frame, motions, self.G, (N, m * D, self.G.shape[1]))
            J.values[:, :, parameters.active_columns(ARM)[0]] = by_arm.reshape(N * m, D, -1)
        found = Linearization(
            residual, J.values.reshape(N, m, D, -1), at.by_frame, motions, joint_axes(problem.arm.chain)
        )
        for model in problem.joint_models:
            if J.wants(model.key):
                by_model = model.jacobian(observed.readings, state[model.key])
                J.put(model.key, (found.J_q @ by_model).reshape(N * m, D, -1))
        return found


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
