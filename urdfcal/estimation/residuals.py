"""From joint space to pixels and points: the seed's eq. 22, with its derivatives (DESIGN section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.robot.kinematics import joint_axes, tip_motion, tip_poses

if TYPE_CHECKING:
    import pinocchio as pin

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Geometry, Parameters
    from urdfcal.estimation.state import State
    from urdfcal.robot.chain import Chain
    from urdfcal.robot.kinematics import TipMotion


_EVERY = slice(None)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Residuals of a block of poses and their derivatives; zero where a slot is padding.

    Attributes:
        residual: (N, m, D) predicted minus measured.
        J: (N, m, D, count) derivative wrt the active parameters.
        tip_to_value: (N, m D, 6) derivative wrt a motion of the tip.
        motion: of the tip.
    """

    residual: Floats
    J: Floats
    tip_to_value: Floats
    motion: TipMotion

    def by_joints(self, chain: Chain) -> Floats:
        """Derivative wrt the joint readings, (N, m, D, n)."""
        J_q = self.tip_to_value @ _carry(self.motion.regressor, joint_axes(chain))
        return J_q.reshape(*self.residual.shape, -1)


def led_positions(table: Geometry, observations: Observations, state: State) -> Floats:
    """Where every LED is in the world, (N, m, 3). [m]."""
    T = tip_poses(table.chain, observations.joints(state.time_offsets), table.placements(state.offsets))
    p_base = T[:, None, :3, 3] + (T[:, None, :3, :3] @ state.leds[observations.led][..., None])[..., 0]
    result: Floats = p_base @ state.T_world_base[:3, :3].T + state.T_world_base[:3, 3]
    return result


def distances_per_unit(table: Geometry, observations: Observations, state: State) -> Floats:
    """What one unit of residual is worth at the LED, (N, m): metres a pixel across the ray, 1 for points."""
    result = np.ones(observations.row.shape)
    if observations.dimension == 3:
        return result
    p_world = led_positions(table, observations, state)
    for c, camera in enumerate(state.cameras):
        seen = observations.camera == c
        T_cam_world = state.T_cam_world[c]
        depth = p_world[seen] @ T_cam_world[2, :3] + T_cam_world[2, 3]
        result[seen] = depth / np.sqrt(camera.intrinsics[0] * camera.intrinsics[1])
    return result


def predict(table: Geometry, observations: Observations, state: State) -> Floats:
    """Where every LED should be seen, (N, m, D); NaN behind a camera, zero for padding."""
    p_world = led_positions(table, observations, state)
    if observations.dimension == 3:
        return np.where(observations.valid[..., None], p_world, 0.0)
    predicted = np.zeros_like(observations.value)
    for c, camera in enumerate(state.cameras):
        seen = observations.camera == c
        T_cam_world = state.T_cam_world[c]
        predicted[seen] = camera.project(p_world[seen] @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
    return predicted


@dataclass(frozen=True, eq=False)
class Tangent:
    """Everything about a state that its derivatives share over the poses: prepared once, evaluated block by block.

    Attributes:
        table: the arm's parameters.
        observations: what was measured.
        state: where to linearise.
        parameters: the derivative's columns.
        model: of the arm at the state.
        G: (6 n, p) body twists of the placements for each of the arm's active parameters.
        q: (N, n) joint values at the state. [rad or m]
    """

    table: Geometry
    observations: Observations
    state: State
    parameters: Parameters
    model: pin.Model
    G: Floats
    q: Floats

    @classmethod
    def at(cls, table: Geometry, observations: Observations, state: State, parameters: Parameters) -> Tangent:
        """Prepare."""
        model = table.chain.build_model(table.placements(state.offsets))
        rows = [row for row, active in zip(parameters.rows, parameters.active, strict=False) if active]
        q = observations.joints(state.time_offsets)
        return cls(table, observations, state, parameters, model, table.twists(state.offsets, rows), q)

    def linearise(self, poses: slice) -> Linearisation:
        """Evaluate residuals and derivatives for some of the observations' N poses.

        With p_base = p + R led, a motion (v, w) of the tip moves the LED by v + w x R led; E carries a motion
        of the LED in the base frame to the measurement.
        """
        state, parameters, observations = self.state, self.parameters, self.observations
        led, camera, measured = observations.led[poses], observations.camera[poses], observations.value[poses]
        motion = tip_motion(self.table.chain, self.model, self.q[poses])
        R_world_base = state.T_world_base[:3, :3]

        # Every LED at every pose as one product, of which the seen ones are taken.
        N, m, D = measured.shape
        levers = (motion.R.reshape(-1, 3) @ state.leds.T).reshape(N, 3, -1)
        lever = levers[np.arange(N)[:, None], :, led]
        p_base = motion.p[:, None] + lever
        p_world = p_base @ R_world_base.T + state.T_world_base[:3, 3]

        J = np.zeros((N * m, D, parameters.count))
        if D == 3:
            residual = (p_world - measured).reshape(-1, 3)
            E = np.broadcast_to(R_world_base, (N * m, 3, 3)).copy()
        else:
            residual, E = np.zeros((N * m, 2)), np.zeros((N * m, 2, 3))
            for c, lens in enumerate(state.cameras):
                seen = np.flatnonzero(camera == c)
                T_cam_world = state.T_cam_world[c]
                p_cam = p_world.reshape(-1, 3)[seen] @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
                if c in parameters.lenses:
                    uv, d_point, d_lens = lens.project_with_derivatives(p_cam)
                    self._put(J, parameters.lens(parameters.lenses.index(c)), d_lens, seen)
                else:
                    uv, d_point = lens.project_with_jacobian(p_cam)
                residual[seen] = uv - measured.reshape(-1, 2)[seen]
                E[seen] = _carry(d_point, T_cam_world[:3, :3] @ R_world_base)
                if c in parameters.cameras:
                    where = parameters.camera(parameters.cameras.index(c))
                    self._put(J, where, np.concatenate([d_point, _turned(d_point, p_cam)], axis=-1), seen)
        padding = ~observations.valid[poses].ravel()
        residual[padding], E[padding] = 0.0, 0.0

        tip_to_value = np.concatenate([E, _turned(E, lever.reshape(-1, 3))], axis=-1).reshape(N, m * D, 6)
        geometry = tip_to_value @ _carry(motion.regressor, self.G)
        J[..., : self.G.shape[1]] = geometry.reshape(N * m, D, -1)
        self._put(J, parameters.base, np.concatenate([E, _turned(E, p_base.reshape(-1, 3))], axis=-1))
        if np.any(parameters.active[parameters.base.stop : parameters.led(parameters.leds).start]):
            d_led = (E.reshape(N, m * D, 3) @ motion.R).reshape(N * m, D, 3)
            for index in range(parameters.leds):
                self._put(J, parameters.led(index), d_led * (led == index).reshape(-1, 1, 1))
        at = Linearisation(residual.reshape(N, m, D), J.reshape(N, m, D, -1), tip_to_value, motion)
        self._put_clocks(J, at, poses)
        return at

    def _put_clocks(self, J: Floats, at: Linearisation, poses: slice) -> None:
        """Write how values move as a camera's clock does: dt later the joints have run on by dq = q' dt."""
        trajectory, clocks = self.observations.trajectory, self.parameters.clocks
        if trajectory is None or not clocks:
            return
        velocity = trajectory.velocities(self.state.time_offsets)[poses]
        by_clock = (at.by_joints(self.table.chain) @ velocity[:, None, :, None]).reshape(*J.shape[:2], 1)
        camera = self.observations.camera[poses]
        for position, c in enumerate(clocks):
            seen = np.flatnonzero(camera == c)
            self._put(J, self.parameters.clock(position), by_clock[seen], seen)

    def _put(self, J: Floats, where: slice, block: Floats, seen: Ints | slice = _EVERY) -> None:
        """Write the active ones of a block of derivatives, by the parameters ``where``, into some rows of J."""
        active = self.parameters.active[where]
        first, count = np.count_nonzero(self.parameters.active[: where.start]), np.count_nonzero(active)
        J[seen, :, first : first + count] = block if count == len(active) else block[..., active]


def _carry(matrices: Floats, right: Floats) -> Floats:
    """``matrices @ right`` as one product: many small ones cost several times as much."""
    N, rows, columns = matrices.shape
    result: Floats = (matrices.reshape(N * rows, columns) @ right).reshape(N, rows, right.shape[1])
    return result


def _turned(E: Floats, lever: Floats) -> Floats:
    """-E [lever]x, how values move as the lever turns: the rows of E crossed with it, (K, D, 3)."""
    a, b = np.moveaxis(E, -1, 0), lever.T[..., None]
    result = np.empty_like(E)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[..., i] = b[j] * a[k] - b[k] * a[j]
    return result
