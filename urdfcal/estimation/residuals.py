"""From joint space to pixels and points: the seed's eq. 22, with its derivatives (DESIGN section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, skew
from urdfcal.robot.kinematics import joint_axes, tip_motion, tip_poses

if TYPE_CHECKING:
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Geometry, Parameters
    from urdfcal.estimation.state import State
    from urdfcal.robot.chain import Chain
    from urdfcal.robot.kinematics import TipMotion


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
    T = tip_poses(table.chain, observations.q, table.placements(state.offsets))
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


def linearise(
    table: Geometry, observations: Observations, state: State, parameters: Parameters, poses: slice
) -> Linearisation:
    """Evaluate residuals and derivatives for some of the poses.

    With p_base = p + R led, a motion (v, w) of the tip moves the LED by v + w x R led; E carries a motion
    of the LED in the base frame to the measurement.

    Args:
        table: the arm's parameters.
        observations: what was measured.
        state: where to linearise.
        parameters: the derivative's columns.
        poses: which of the observations' N poses.
    """
    chain = table.chain
    led, camera = observations.led[poses], observations.camera[poses]
    valid = observations.valid[poses]
    motion = tip_motion(chain, observations.q[poses], table.placements(state.offsets))
    R_world_base = state.T_world_base[:3, :3]

    lever = (motion.R[:, None] @ state.leds[led][..., None])[..., 0]
    p_base = motion.p[:, None] + lever
    p_world = p_base @ R_world_base.T + state.T_world_base[:3, 3]

    N, m, D = *valid.shape, observations.dimension
    J = np.zeros((N, m, D, parameters.size))
    if D == 3:
        residual = p_world - observations.value[poses]
        E = np.broadcast_to(R_world_base, (N, m, 3, 3)) * valid[..., None, None]
    else:
        residual, E = np.zeros((N, m, 2)), np.zeros((N, m, 2, 3))
        for c, lens in enumerate(state.cameras):
            seen = camera == c
            T_cam_world = state.T_cam_world[c]
            p_cam = p_world[seen] @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
            if c in parameters.lenses:
                uv, d_point, d_lens = lens.project_with_derivatives(p_cam)
                J[seen, :, parameters.lens(parameters.lenses.index(c))] = d_lens
            else:
                uv, d_point = lens.project_with_jacobian(p_cam)
            residual[seen] = uv - observations.value[poses][seen]
            E[seen] = d_point @ (T_cam_world[:3, :3] @ R_world_base)
            if c in parameters.cameras:
                where = parameters.camera(parameters.cameras.index(c))
                J[seen, :, where] = np.concatenate([d_point, -d_point @ skew(p_cam)], axis=-1)
    residual = np.where(valid[..., None], residual, 0.0)

    tip_to_value = np.concatenate([E, -E @ skew(lever)], axis=-1).reshape(N, m * D, 6)
    G = table.twists(state.offsets, parameters.rows)
    geometry = tip_to_value @ _carry(motion.regressor, G)
    J[..., : len(parameters.rows)] = geometry.reshape(N, m, D, -1)
    J[..., parameters.base] = np.concatenate([E, -E @ skew(p_base)], axis=-1)
    d_led = E @ motion.R[:, None]
    for index in range(parameters.leds):
        J[..., parameters.led(index)] = d_led * (led == index)[..., None, None]
    return Linearisation(residual, J[..., parameters.active], tip_to_value, motion)


def _carry(regressor: Floats, G: Floats) -> Floats:
    """``regressor @ G`` as one product: many small ones cost several times as much."""
    N, rows, columns = regressor.shape
    result: Floats = (regressor.reshape(N * rows, columns) @ G).reshape(N, rows, -1)
    return result
