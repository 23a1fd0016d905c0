"""Where a camera is and what its lens does, as two unknowns."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.cameras.camera import Camera
from urdfcal.estimation.blocks.base import POSE_AXES, POSE_UNITS, Block, LeftPoseBlock
from urdfcal.estimation.blocks.scale import scale_of
from urdfcal.estimation.state import Key, State

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.session.attachments import Attachments


def pose_key(camera: str) -> Key[Floats]:
    """Key of a camera's pose (4, 4): T_cam_frame of a reference camera, T_cam_reference of the others. [m]."""
    return Key(f"{camera}.pose")


def lens_key(camera: str) -> Key[Camera]:
    """Key of a camera's intrinsics and distortion."""
    return Key(f"{camera}.lens")


class CameraPoseBlock(LeftPoseBlock):
    """The pose of a camera in the frame that it is attached to, or relative to its reference camera."""

    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, camera: str, nominal: Floats, sigma: Floats) -> CameraPoseBlock:
        """Take all six coordinates; those of standard deviation 0 are fixed."""
        return cls(
            key=pose_key(camera),
            names=tuple(f"{camera}.{axis}" for axis in POSE_AXES),
            units=POSE_UNITS,
            nominal=nominal,
            sigma=np.where(sigma > 0.0, sigma, np.inf),
            fixed=_exact(sigma),
            phrase=f"where {camera} is attached",
        )


class LensBlock(Block[Camera]):
    """The intrinsics and distortion coefficients of a camera."""

    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, nominal: Camera, sigma: Floats) -> LensBlock:
        """Take all parameters; those of standard deviation 0 are fixed."""
        names = nominal.parameter_names
        return cls(
            key=lens_key(nominal.name),
            names=tuple(f"{nominal.name}.{name}" for name in names),
            units=("px",) * 4 + ("1",) * (len(names) - 4),
            nominal=nominal,
            sigma=np.where(sigma > 0.0, sigma, np.inf),
            fixed=_exact(sigma),
            phrase="",
        )

    def retract(self, value: Camera, step: Floats) -> Camera:
        """Add the step to the parameters."""
        return value.with_parameters(value.parameters + step)

    def local(self, value: Camera) -> tuple[Floats, Floats]:
        """Return the difference from the nominal parameters, and the identity."""
        return value.parameters - self.nominal.parameters, np.eye(len(self))

    def scale(self, value: Camera) -> Floats:
        """Pixels count in focal lengths."""
        fx, fy = value.intrinsics[:2]
        return np.concatenate([[fx, fy, fx, fy], np.ones(len(self) - 4)])


def lens_key_of(attachments: Attachments, c: int) -> Key[Camera]:
    """Key of the lens that a camera has, perhaps with others: it is the same one before and after a move."""
    return lens_key(attachments.cameras[int(attachments.lens[c])])


def camera_values(attachments: Attachments, state: State) -> tuple[Camera, ...]:
    """Lenses of all cameras, in the rig's order and by their names; none where the state holds none."""
    lenses = [state[key] for c in range(len(attachments.cameras)) if (key := lens_key_of(attachments, c)) in state]
    named = zip(lenses, attachments.cameras, strict=False)
    return tuple(lens if lens.name == name else replace(lens, name=name) for lens, name in named)


def camera_poses(attachments: Attachments, state: State) -> Floats:
    """T_cam_frame (C, 4, 4) of all cameras: the frame each is attached to, in the camera. [m]."""
    poses: list[Floats] = []
    for c, (name, reference) in enumerate(zip(attachments.cameras, attachments.reference.tolist(), strict=True)):
        if pose_key(name) not in state:
            break
        T = own_pose(attachments, state, c)
        poses.append(T if reference == c else T @ poses[reference])
    return np.array(poses).reshape(-1, 4, 4)


def own_pose(attachments: Attachments, state: State, c: int) -> Floats:
    """T_cam_frame (4, 4) of a reference camera; of the others T_cam_reference, a given baseline at its true length."""
    T, scale = state[pose_key(attachments.cameras[c])], scale_of(state)
    if scale == 1.0 or not has_scale(attachments, c):
        return T
    shrunk = np.array(T)
    shrunk[:3, 3] /= scale
    return shrunk


def has_scale(attachments: Attachments, c: int) -> bool:
    """Return whether a camera's baseline is given, in the unit of the board that calibrated it."""
    return bool(attachments.reference[c] != c) and attachments.T_cam_reference[c] is not None


def has_cameras(state: State) -> bool:
    """Return whether a state holds cameras."""
    return any(isinstance(state[key], Camera) for key in state)


def without_cameras(state: State) -> State:
    """Return the same state where cameras have no part, as where it is estimated from points."""
    names = [state[key].name for key in state if isinstance(state[key], Camera)]
    gone = {key for name in names for key in (pose_key(name), lens_key(name))}
    return State({key: state[key] for key in state if key not in gone})


def _exact(sigma: Floats) -> dict[int, str]:
    return {int(k): "its calibration gives it as exact" for k in np.flatnonzero(sigma == 0.0)}
