"""Poses: where and how turned a tracker saw a body, such as its 6-D probe or a set of markers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.estimation.alignment import place_base
from urdfcal.estimation.blocks.base_pose import base_keys
from urdfcal.estimation.blocks.scale import SCALE, scale_of
from urdfcal.estimation.blocks.targets import target_key
from urdfcal.estimation.measurements.base import ByFrame, Measurement
from urdfcal.estimation.measurements.point_geometry import by_frames, seen_from
from urdfcal.estimation.target_start import mean_pose
from urdfcal.rotations import matrix_to_rotation_vector, quaternion_to_matrix, skew
from urdfcal.session.measurements import NoiseField

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.linearize import Jacobian
    from urdfcal.estimation.links import Links
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.start import Start
    from urdfcal.estimation.state import Key, State
    from urdfcal.session.attachments import Attachments

# Below this angle the series of the inverse Jacobian is exact to rounding. [rad]
_SMALL = 1e-4


@dataclass(frozen=True, eq=False)
class Poses(Measurement):
    """Poses of targets in the world, sorted by pose and target.

    Residuals are six numbers: the position predicted less that measured, in the world, and the rotation vector from the
    orientation measured to that predicted, in the measured body's axes.

    Attributes:
        pose: (S,) index of the arm's pose.
        target: (S,) index of the target.
        place: (S, 7) its position, and its orientation as a unit quaternion x y z w, in the tracker's frame. [m, 1]
        sigma: (S,) standard deviation of each coordinate; one number serves all. [m]
        sigma_rad: (S,) standard deviation of the turn about each axis; one number serves all. [rad]
    """

    kind: ClassVar[str] = "poses"
    keys: ClassVar[tuple[str, ...]] = ("pose", "target")
    dimension: ClassVar[int] = 6
    columns: ClassVar[tuple[str, ...]] = ("x", "y", "z", "qx", "qy", "qz", "qw")
    array: ClassVar[str] = "place"
    noise: ClassVar[str] = "pose"
    usual: ClassVar[float] = 1e-4
    unit: ClassVar[str] = "m"
    report: ClassVar[tuple[str, float]] = ("mm", 1e3)
    # A laser tracker's 6-D probe: 0.01 degrees.
    spreads: ClassVar[Mapping[str, NoiseField]] = {
        "sigma": NoiseField("pose", 1e-4, "m", slice(0, 3)),
        "sigma_rad": NoiseField("pose_rad", 2e-4, "rad", slice(3, 6)),
    }
    lengths: ClassVar[slice] = slice(0, 3)

    target: Ints
    place: Floats
    sigma: Floats
    sigma_rad: Floats

    @property
    def compared(self) -> Floats:
        """Zeros: predictions are differences already."""
        return np.zeros((len(self), 6))

    @property
    def covariances(self) -> Floats:
        """Covariance (S, 6, 6) of each pose."""
        sigma = np.repeat(np.column_stack([self.sigma, self.sigma_rad]), 3, axis=1)
        result: Floats = sigma[:, :, None] ** 2 * np.eye(6)
        return result

    @cached_property
    def rotations(self) -> Floats:
        """(S, 3, 3) orientations as measured."""
        return np.array([quaternion_to_matrix(q) for q in self.place[:, 3:]])

    def predict(self, observed: Observations, links: Links, state: State) -> Floats:
        """Return the differences (N, m, 6) of predicted poses from the measured ones. [m, rad]."""
        return self._difference(observed, links, state)[0]

    def linearise(self, observed: Observations, links: Links, state: State, J: Jacobian) -> ByFrame:
        """Differentiate by the frames, the targets' among them."""
        predicted, p_base, p_world, measured = self._difference(observed, links, state)
        frame, world = self._frames(observed, links), np.zeros_like(observed.row)
        R_world_base, used = np.swapaxes(links.R[0], 1, 2), observed.valid.reshape(-1, 1, 1)
        R_world_base = np.repeat(R_world_base, world.shape[1], axis=0)
        E, turned = np.zeros((world.size, 6, 3)), np.zeros((world.size, 6, 3))
        E[:, :3] = scale_of(state) * R_world_base
        into = np.swapaxes(measured, -1, -2).reshape(-1, 3, 3)
        turned[:, 3:] = _inverse_left_jacobian(predicted[..., 3:].reshape(-1, 3)) @ (into @ R_world_base)
        E, turned = E * used, turned * used
        if J.wants(SCALE):
            J.put(SCALE, np.concatenate([p_world, 0.0 * p_world], axis=-1).reshape(-1, 6, 1) * used)
        by_frame = list(by_frames(links, E, np.zeros_like(p_base), p_base, frame, world))
        N, m = world.shape
        for k, by in enumerate(by_frame):
            if by is not None:
                sign = (frame == k).astype(float) - (world == k)
                by[:, :, 3:] += (turned * sign.reshape(-1, 1, 1)).reshape(N, m * 6, 3)
        return ByFrame(predicted, tuple(by_frame))

    def points(self, observed: Observations, links: Links, state: State) -> tuple[Ints, Floats]:
        """Return the world as the frame, and the targets' origins in it."""
        world = np.zeros_like(observed.row)
        _, _, p_world, _ = self._difference(observed, links, state)
        return world, p_world

    @classmethod
    def defines_world(cls, attachments: Attachments) -> bool:
        """Return True: the tracker's frame is the world."""
        del attachments
        return True

    def start(self, at: Start, state: State) -> State:
        """Place the base, if need be, by the targets' origins as points of unknown place, then the targets.

        An arm that hardly turns its tool does not tell by turns how a target is fastened; that is left to the solver.
        """
        attachments, names = at.session.attachments, at.session.attachments.targets
        carrier = attachments.carrier[attachments.first_target :][self.target]
        T_base_link = np.empty((len(self), 4, 4))
        for frame in np.unique(carrier).tolist():
            T_base_link[carrier == frame] = at.frame(frame, self.pose[carrier == frame], state)
        T = np.tile(np.eye(4), (len(self), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = self.rotations, self.place[:, :3]
        some = np.array([target_key(name) in state for name in names])
        guesses = [state[target_key(name)][:3, 3] if target_key(name) in state else np.zeros(3) for name in names]
        for k, base in enumerate(base_keys(attachments.parts)):
            moving = (carrier > 0) & (at.session.part[self.pose] == k)
            if base not in state and moving.any():
                T_world_base, _ = place_base(
                    T_base_link[moving], self.target[moving], T[moving, :3, 3], np.array(guesses), ~some, some
                )
                state = state.replace({base: T_world_base})
        T_world_link = inverse(at.frame(0, self.pose, state)) @ T_base_link
        found: dict[Key[Floats], Floats] = {}
        for k in np.unique(self.target).tolist():
            mine, key = self.target == k, target_key(names[k])
            if key not in state:
                link = np.eye(4) if carrier[mine][0] == 0 else T_world_link[mine]
                found[key] = mean_pose(inverse(link) @ T[mine])
        return state.replace(found)

    def _frames(self, observed: Observations, links: Links) -> Ints:
        """Frame (N, m) of each slot's target."""
        frames: Ints = links.attachments.first_target + observed.index["target"]
        return frames

    def _difference(self, observed: Observations, links: Links, state: State) -> tuple[Floats, Floats, Floats, Floats]:
        """The differences (N, m, 6); origins in the base link and in the world (N, m, 3); measured rotations."""
        frame, each = self._frames(observed, links), np.arange(len(observed.row))[:, None]
        R = np.stack(np.broadcast_arrays(*links.R))[frame, each]
        p_base = np.stack(np.broadcast_arrays(*links.p))[frame, each]
        p_world = seen_from(links, p_base, np.zeros_like(observed.row))
        measured = self.rotations[observed.row]
        turned = np.swapaxes(measured, -1, -2) @ np.swapaxes(links.R[0], 1, 2)[:, None] @ R
        moved = scale_of(state) * p_world - self.place[observed.row, :3]
        return np.concatenate([moved, matrix_to_rotation_vector(turned)], axis=-1), p_base, p_world, measured


def _inverse_left_jacobian(w: Floats) -> Floats:
    """How rotation vectors (K, 3) change with a small turn from the left, (K, 3, 3)."""
    angle = np.linalg.norm(w, axis=1)[:, None, None]
    half, W = 0.5 * np.maximum(angle, _SMALL), skew(w)
    factor = np.where(angle < _SMALL, 1.0 / 12.0, (1.0 - half / np.tan(half)) / np.maximum(angle, _SMALL) ** 2)
    result: Floats = np.eye(3) - 0.5 * W + factor * (W @ W)
    return result
