"""The values of a state under plain names, for what draws or writes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import frozen
from urdfcal.estimation.blocks.base_pose import base_keys
from urdfcal.estimation.blocks.cameras import camera_poses, camera_values
from urdfcal.estimation.blocks.targets import point_places, target_key
from urdfcal.estimation.joint_models.time_offset import time_offsets

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.cameras.camera import Camera
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.state import State


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A robot, its LEDs and its cameras at one state.

    Attributes:
        offsets: (rows, columns) of the arm's parameterization, with what it can hold of the joint models. [rad, m]
        T_world_bases: (W, 4, 4) the base link in the world, in each part of the session. [m]
        leds: (L + M, 3) LED positions and points of targets, each in the frame that it is attached to. [m]
        targets: (T, 4, 4) each target in the frame that carries it. [m]
        cameras: lenses, in the rig's order; none where cameras have no part.
        T_cam_frame: (C, 4, 4) in each camera the frame that it is fixed in: the world, or a link. [m]
        time_offsets: (C,) of the cameras' clocks, t_robot = t_camera + offset; empty where the arm stood still. [s]
    """

    offsets: Floats
    T_world_bases: Floats
    leds: Floats
    targets: Floats
    cameras: tuple[Camera, ...]
    T_cam_frame: Floats
    time_offsets: Floats

    @property
    def T_world_base(self) -> Floats:
        """(4, 4) the base link in the world, where it stood first. [m]."""
        first: Floats = self.T_world_bases[0]
        return first

    @classmethod
    def of(cls, problem: Problem, state: State) -> Snapshot:
        """Look the values up."""
        return cls(
            offsets=frozen(problem.offsets(state)),
            T_world_bases=frozen([state[key] for key in base_keys(problem.attachments.parts)]),
            leds=frozen(point_places(problem.attachments, state)),
            targets=frozen(
                np.array([state[target_key(name)] for name in problem.attachments.targets]).reshape(-1, 4, 4)
            ),
            cameras=camera_values(problem.attachments, state),
            T_cam_frame=frozen(camera_poses(problem.attachments, state)),
            time_offsets=time_offsets(state),
        )
