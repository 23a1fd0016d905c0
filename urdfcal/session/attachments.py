"""What LEDs and cameras are attached to: links of the robot, or the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, Ints, frozen, inverse, keep
from urdfcal.errors import SessionError
from urdfcal.robot.mechanism import Tip  # noqa: TC001  # a field's type

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.cameras.rig import Rig
    from urdfcal.robot.mechanism import Mechanism

WORLD = "world"
"""Stands for no link: what neither moves with the robot nor is part of it."""


@dataclass(frozen=True, eq=False)
class CameraMount:
    """An eye-in-hand camera: what link it is on, and where.

    Attributes:
        camera: its name.
        link: what it is fastened to.
        T_link_camera: (4, 4) how, None where unknown. [m]
        sigma: (6,) how well that is known, standard deviations of a small motion x y z rx ry rz of the link in the
            camera's frame; None where it is only a guess to start from. [m, rad]
    """

    camera: str
    link: str
    T_link_camera: Floats | None = None
    sigma: Floats | None = None

    def __post_init__(self) -> None:
        where = f"camera {self.camera!r}"
        if self.link == WORLD:
            remedy = "Name the camera file alone: T_cn_cnm1 says where it stands, or it is estimated."
            raise SessionError("a camera that stands in the world is on no link", where=where, remedy=remedy)
        if self.T_link_camera is not None:
            T = frozen(self.T_link_camera)
            R = T[:3, :3] if T.shape == (4, 4) else np.zeros((3, 3))
            if not np.allclose(R @ R.T, np.eye(3), rtol=0.0, atol=1e-9) or np.linalg.det(R) < 0.0:
                raise SessionError("T_link_camera is no rigid 4 x 4 transform", where=where)
            keep(self, T_link_camera=T)
        if self.sigma is not None:
            sigma = frozen(self.sigma)
            if self.T_link_camera is None:
                raise SessionError("sigma is given without a place", where=where)
            if sigma.shape != (6,) or not np.all(np.isfinite(sigma) & (sigma > 0.0)):
                raise SessionError(f"sigma is {sigma.tolist()}, not six positive numbers", where=where)
            keep(self, sigma=sigma)


@dataclass(frozen=True, eq=False)
class Attachments:
    """The frames that LEDs and cameras are fixed in: 0 is the world, the others are links.

    The world is the frame of the first eye-to-hand camera, or of the tracker; where all cameras are eye-in-hand it is
    the base link's. Of a session of parts each has its world, and frame 0 is that of the pose's part.

    Attributes:
        tips: the links of frames 1, 2, ...
        led: (L,) frame of each LED.
        cameras: names of the C cameras.
        camera: (C,) frame of each camera.
        reference: (C,) for each camera the first one in the same frame: its pose is known relative to that one's.
        T_cam_reference: for each camera (4, 4) its reference camera, None where that is not known. [m]
        T_reference_frame: for each camera (4, 4) the frame in its reference camera, None where not known. [m]
        lens: (C,) for each camera the one whose lens it has.
        parts: the names of the session's parts.
    """

    tips: tuple[Tip, ...]
    led: Ints
    cameras: tuple[str, ...]
    camera: Ints
    reference: Ints
    T_cam_reference: tuple[Floats | None, ...]
    T_reference_frame: tuple[Floats | None, ...]
    lens: Ints
    parts: tuple[str, ...]

    @property
    def frames(self) -> tuple[str, ...]:
        """The name of each frame: the world, or a link."""
        return (WORLD, *(tip.link for tip in self.tips))

    @property
    def eye_to_hand(self) -> Ints:
        """Indices of the cameras that are fixed in the world."""
        return np.flatnonzero(self.camera == 0)

    @property
    def worlds(self) -> Ints:
        """Indices of the cameras that define a world: the first ones that are fixed in it."""
        return np.flatnonzero((self.camera == 0) & (self.reference == np.arange(len(self.camera))))

    @property
    def T_cam_frame(self) -> tuple[Floats | None, ...]:
        """For each camera (4, 4) the frame it is fixed in, as far as it is known beforehand. [m]."""
        return tuple(
            None if a is None or b is None else a @ b
            for a, b in zip(self.T_cam_reference, self.T_reference_frame, strict=True)
        )


def attach(
    mechanism: Mechanism,
    led_links: Sequence[str | None],
    rig: Rig,
    mounts: Mapping[str, CameraMount],
    parts: Sequence[str] = ("",),
) -> Attachments:
    """Sort LEDs and cameras by what they are attached to.

    Args:
        mechanism: the robot.
        led_links: a link for each LED, or "world"; None for the tip link.
        rig: the cameras.
        mounts: of the eye-in-hand ones, by name.
        parts: the names of the session's parts.

    Raises:
        RobotError: a link is none of the mechanism's tips.
        SessionError: nothing is on the robot, a camera's pose is given by one in another frame, or on its link though
            its reference camera gives it there.
    """
    led_at = [link or mechanism.tip_link for link in led_links]
    camera_at = [mounts[name].link if name in mounts else WORLD for name in rig.names]
    names = list(dict.fromkeys([WORLD, *led_at, *camera_at]))
    led, camera = ([names.index(link) for link in links] for links in (led_at, camera_at))
    together = list(zip(camera, rig.group, strict=True))
    reference = [together.index(of) for of in together]
    if len(names) == 1:
        raise SessionError("neither an LED nor a camera is on the robot", remedy="Name the link that carries one.")
    T_cam_reference: list[Floats | None] = []
    T_reference_frame: list[Floats | None] = []
    for c, (name, first) in enumerate(zip(rig.names, reference, strict=True)):
        T, T_first = rig.T_cam_world[c], rig.T_cam_world[first]
        if c != rig.group[c] and c == first and T is not None:
            what = "T_cn_cnm1 places it by a camera that is fastened to something else"
            remedy = "Leave T_cn_cnm1 out: where it is comes from its link, or is estimated."
            raise SessionError(what, where=f"camera {name!r}", remedy=remedy)
        if c != first and name in mounts and mounts[name].T_link_camera is not None:
            what = f"its place on {mounts[name].link!r} is given, but there it goes with {rig.names[first]!r}"
            remedy = "Leave position, rpy and sigma out: T_cn_cnm1 says where it is, or it is estimated."
            raise SessionError(what, where=f"camera {name!r}", remedy=remedy)
        known = None if T is None or T_first is None else T @ inverse(T_first)
        T_cam_reference.append(np.eye(4) if c == first else known)
        mount = mounts.get(rig.names[first])
        given = np.eye(4) if mount is None else mount.T_link_camera
        T_reference_frame.append(None if given is None else inverse(given))
    return Attachments(
        tuple(mechanism.tip(name) for name in names[1:]),
        frozen(led, np.intp),
        tuple(rig.names),
        frozen(camera, np.intp),
        frozen(reference, np.intp),
        tuple(T_cam_reference),
        tuple(T_reference_frame),
        frozen(rig.lens, np.intp),
        tuple(parts),
    )
