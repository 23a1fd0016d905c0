"""From joint space to pixels and points: the seed's eq. 22, with its derivatives (DESIGN section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.robot.kinematics import joint_axes, link_motions, link_poses

if TYPE_CHECKING:
    import pinocchio as pin

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Geometry, Parameters
    from urdfcal.estimation.state import State
    from urdfcal.robot.kinematics import LinkMotion
    from urdfcal.robot.mechanism import Mechanism


_EVERY = slice(None)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Residuals of a block of poses and their derivatives; zero where a slot is padding.

    Attributes:
        residual: (N, m, D) predicted minus measured.
        J: (N, m, D, count) derivative wrt the active parameters.
        link_to_value: for each link that carries LEDs or cameras (N, m D, 6) derivative wrt a motion of it.
        motions: of these links.
    """

    residual: Floats
    J: Floats
    link_to_value: tuple[Floats, ...]
    motions: tuple[LinkMotion, ...]

    def by_joints(self, mechanism: Mechanism) -> Floats:
        """Derivative wrt the joint readings, (N, m, D, n)."""
        return _by_placements(self.link_to_value, self.motions, joint_axes(mechanism)).reshape(*self.residual.shape, -1)


def view(table: Geometry, observations: Observations, state: State) -> Floats:
    """Where every LED is in the frame that its camera is fixed in, (N, m, 3): the world, or a link. [m]."""
    frames = observations.frames
    q = observations.joints(state.time_offsets)
    poses = link_poses(table.chain, q, frames.tips, table.placements(state.offsets))
    T_base_world = inverse(state.T_world_base)
    view_frame = observations.view_frame
    p_base = np.zeros((*view_frame.shape, 3))
    for index, led in enumerate(state.leds):
        seen = observations.led == index
        T = poses[frames.led[index] - 1] if frames.led[index] else T_base_world[None]
        place = np.broadcast_to((T[:, :3, :3] @ led + T[:, :3, 3])[:, None], p_base.shape)
        p_base = place if seen.all() else np.where(seen[..., None], place, p_base)
    result = np.zeros_like(p_base)
    for frame in range(len(frames.tips) + 1):
        here = view_frame == frame
        if not here.any():
            continue
        if frame == 0:
            place = p_base @ state.T_world_base[:3, :3].T + state.T_world_base[:3, 3]
        else:
            T = poses[frame - 1]
            place = (p_base - T[:, None, :3, 3]) @ T[:, :3, :3]
        result = place if here.all() else np.where(here[..., None], place, result)
    return result


def distances_per_unit(table: Geometry, observations: Observations, state: State) -> Floats:
    """What one unit of residual is worth at the LED, (N, m): metres a pixel across the ray, 1 for points."""
    result = np.ones(observations.row.shape)
    if observations.dimension == 3:
        return result
    p_view = view(table, observations, state)
    for c, camera in enumerate(state.cameras):
        seen = observations.camera == c
        T_cam_view = state.T_cam_world[c]
        depth = p_view[seen] @ T_cam_view[2, :3] + T_cam_view[2, 3]
        result[seen] = depth / np.sqrt(camera.intrinsics[0] * camera.intrinsics[1])
    return result


def predict(table: Geometry, observations: Observations, state: State) -> Floats:
    """Where every LED should be seen, (N, m, D); NaN behind a camera, zero for padding."""
    p_view = view(table, observations, state)
    if observations.dimension == 3:
        return np.where(observations.valid[..., None], p_view, 0.0)
    predicted = np.zeros_like(observations.value)
    for c, camera in enumerate(state.cameras):
        seen = observations.camera == c
        T_cam_view = state.T_cam_world[c]
        predicted[seen] = camera.project(p_view[seen] @ T_cam_view[:3, :3].T + T_cam_view[:3, 3])
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

        With p_base = p + R led, a motion (v, w) of the LED's link moves it by v + w x R led; one of the camera's link
        moves it backwards by v + w x (p_base - p) as the camera sees it. E carries a motion of the LED in the base
        frame to the measurement.
        """
        state, parameters, observations = self.state, self.parameters, self.observations
        frames = observations.frames
        led, camera, measured = observations.led[poses], observations.camera[poses], observations.value[poses]
        led_frame, view_frame = frames.led[led], observations.view_frame[poses]
        motions = link_motions(self.table.chain, self.model, self.q[poses], frames.tips)
        R_world_base, t_world_base = state.T_world_base[:3, :3], state.T_world_base[:3, 3]
        N, m, D = measured.shape

        lever, p_base = self._place(motions, led, led_frame)
        J = np.zeros((N * m, D, parameters.count))
        if D == 3:
            residual = (p_base @ R_world_base.T + t_world_base - measured).reshape(-1, 3)
            E = np.broadcast_to(R_world_base, (N * m, 3, 3)).copy()
        else:
            residual, E = np.zeros((N * m, 2)), np.zeros((N * m, 2, 3))
            for c, lens in enumerate(state.cameras):
                seen = np.flatnonzero(camera == c)
                T_cam_view, frame = state.T_cam_world[c], int(frames.camera[c])
                p_seen = p_base.reshape(-1, 3)[seen]
                if frame == 0:
                    p_view = p_seen @ R_world_base.T + t_world_base
                    R_cam_base = T_cam_view[:3, :3] @ R_world_base
                else:
                    R_base_view = motions[frame - 1].R[seen // m]
                    p_view = ((p_seen - motions[frame - 1].p[seen // m])[:, None] @ R_base_view)[:, 0]
                    R_cam_base = T_cam_view[:3, :3] @ np.swapaxes(R_base_view, 1, 2)
                p_cam = p_view @ T_cam_view[:3, :3].T + T_cam_view[:3, 3]
                if c in parameters.lenses:
                    uv, d_point, d_lens = lens.project_with_derivatives(p_cam)
                    self._put(J, parameters.lens(parameters.lenses.index(c)), d_lens, seen)
                else:
                    uv, d_point = lens.project_with_jacobian(p_cam)
                residual[seen] = uv - measured.reshape(-1, 2)[seen]
                E[seen] = _carry(d_point, R_cam_base) if frame == 0 else d_point @ R_cam_base
                self._put_places(J, c, d_point, p_cam, seen)
        padding = ~observations.valid[poses].ravel()
        residual[padding], E[padding] = 0.0, 0.0

        link_to_value = tuple(
            self._link_to_value(E, lever, p_base, motion, led_frame == frame, view_frame == frame)
            for frame, motion in enumerate(motions, start=1)
        )
        geometry = _by_placements(link_to_value, motions, self.G)
        J[..., : self.G.shape[1]] = geometry.reshape(N * m, D, -1)
        # The world moves with the camera that stands in it, or with the LED.
        sign = (view_frame == 0).astype(float).ravel() - (led_frame == 0).ravel()
        by_base = np.concatenate([E, _turned(E, p_base.reshape(-1, 3))], axis=-1)
        self._put(J, parameters.base, by_base if np.all(sign == 1.0) else sign[:, None, None] * by_base)
        if np.any(parameters.active[parameters.base.stop : parameters.led(parameters.leds).start]):
            R_base_frame = [np.broadcast_to(R_world_base.T, (N, 3, 3)), *(motion.R for motion in motions)]
            for index in range(parameters.leds):
                d_led = (E.reshape(N, m * D, 3) @ R_base_frame[frames.led[index]]).reshape(N * m, D, 3)
                self._put(J, parameters.led(index), d_led * (led == index).reshape(-1, 1, 1))
        at = Linearisation(residual.reshape(N, m, D), J.reshape(N, m, D, -1), link_to_value, motions)
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

    def _place(self, motions: tuple[LinkMotion, ...], led: Ints, led_frame: Ints) -> tuple[Floats, Floats]:
        """The LEDs of the slots (N, m): from their link's origin, and from the base link's, both (N, m, 3), m."""
        N, m = led.shape
        lever, p_base = np.zeros((N, m, 3)), np.zeros((N, m, 3))
        each = np.arange(N)[:, None]
        for frame, motion in enumerate(motions, start=1):
            # Every LED at every pose as one product, of which the seen ones are taken.
            levers = (motion.R.reshape(-1, 3) @ self.state.leds.T).reshape(N, 3, -1)
            here = led_frame == frame
            if not here.any():
                continue
            levers = levers[each, :, led]
            lever, p_base = (
                (levers, motion.p[:, None] + levers)
                if here.all()
                else (
                    np.where(here[..., None], levers, lever),
                    np.where(here[..., None], motion.p[:, None] + levers, p_base),
                )
            )
        standing = led_frame == 0
        if standing.any():
            T_base_world = inverse(self.state.T_world_base)
            p_base[standing] = self.state.leds[led[standing]] @ T_base_world[:3, :3].T + T_base_world[:3, 3]
        return lever, p_base

    def _put_places(self, J: Floats, c: int, d_point: Floats, p_cam: Floats, seen: Ints) -> None:
        """Write the derivatives by the places of a camera, and of the one that leads it on its link."""
        parameters, T = self.parameters, self.state.T_cam_world
        if c in parameters.cameras:
            where = parameters.camera(parameters.cameras.index(c))
            self._put(J, where, np.concatenate([d_point, _turned(d_point, p_cam)], axis=-1), seen)
        leader = int(self.observations.frames.leader[c])
        if leader != c and leader in parameters.cameras:
            T_cam_leader = T[c] @ inverse(T[leader])
            p_leader = (p_cam - T_cam_leader[:3, 3]) @ T_cam_leader[:3, :3]
            by_leader = _carry(d_point, T_cam_leader[:3, :3])
            where = parameters.camera(parameters.cameras.index(leader))
            self._put(J, where, np.concatenate([by_leader, _turned(by_leader, p_leader)], axis=-1), seen)

    @staticmethod
    def _link_to_value(
        E: Floats, lever: Floats, p_base: Floats, motion: LinkMotion, carries: Bools, watches: Bools
    ) -> Floats:
        """Derivative (N, m D, 6) wrt a link's motion: of the LEDs it carries (N, m), against what it watches (N, m)."""
        result = np.concatenate([E, _turned(E, lever.reshape(-1, 3))], axis=-1)
        if not carries.all():
            result *= carries.reshape(-1, 1, 1)
        if watches.any():
            from_link = (p_base - motion.p[:, None]).reshape(-1, 3)
            result -= np.concatenate([E, _turned(E, from_link)], axis=-1) * watches.reshape(-1, 1, 1)
        return result.reshape(len(lever), -1, 6)

    def _put(self, J: Floats, where: slice, block: Floats, seen: Ints | slice = _EVERY) -> None:
        """Write the active ones of a block of derivatives, by the parameters ``where``, into some rows of J."""
        active = self.parameters.active[where]
        first, count = np.count_nonzero(self.parameters.active[: where.start]), np.count_nonzero(active)
        J[seen, :, first : first + count] = block if count == len(active) else block[..., active]


def _by_placements(link_to_value: tuple[Floats, ...], motions: tuple[LinkMotion, ...], G: Floats) -> Floats:
    """Derivative (N, m D, p) by what moves the placements as G (6 n, p)."""
    parts = [values @ _carry(motion.regressor, G) for values, motion in zip(link_to_value, motions, strict=True)]
    return sum(parts[1:], start=parts[0])


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
