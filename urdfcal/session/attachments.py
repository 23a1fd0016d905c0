"""What LEDs, targets and cameras are attached to: links of the robot, or the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, Ints, frozen, inverse
from urdfcal.errors import SessionError
from urdfcal.names import check_names
from urdfcal.robot.mechanism import BASE, Tip
from urdfcal.session.place import check_place

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from urdfcal.cameras.rig import Rig
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.target import Target

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
        check_place(self, "T_link_camera", where, exact=False)


@dataclass(frozen=True, eq=False)
class Attachments:
    """The frames that LEDs, targets and cameras are fixed in: 0 is the world, then links, then the targets themselves.

    A target is a frame that moves with its carrier, a link or the world; its points are fixed in it and are counted
    after the LEDs, so that whatever measures LEDs measures them, too. The world is the frame of the first eye-to-hand
    camera, or of the tracker; where all cameras are eye-in-hand it is the base link's. Of a session of parts each has
    its world, and frame 0 is that of the pose's part.

    Attributes:
        tips: the links of frames 1, 2, ...
        targets: names of the T targets, which are the frames after these.
        carrier: (F,) frame that each frame moves with: itself, or of a target the world or a link.
        led: (L + M,) frame of each LED and of each target's points.
        target_points: (M, 3) each in its target's frame. [m]
        cameras: names of the C cameras.
        camera: (C,) frame of each camera.
        reference: (C,) for each camera the first one in the same frame: its pose is known relative to that one's.
        T_cam_reference: for each camera (4, 4) its reference camera, None where that is not known. [m]
        T_reference_frame: for each camera (4, 4) the frame in its reference camera, None where not known. [m]
        lens: (C,) for each camera the one whose lens it has.
        parts: the names of the session's parts.
    """

    tips: tuple[Tip, ...]
    targets: tuple[str, ...]
    carrier: Ints
    led: Ints
    target_points: Floats
    cameras: tuple[str, ...]
    camera: Ints
    reference: Ints
    T_cam_reference: tuple[Floats | None, ...]
    T_reference_frame: tuple[Floats | None, ...]
    lens: Ints
    parts: tuple[str, ...]

    @property
    def frames(self) -> tuple[str, ...]:
        """The name of each frame: the world, a link, or a target."""
        return (WORLD, *(tip.link for tip in self.tips), *self.targets)

    @property
    def first_target(self) -> int:
        """The frame of the first target; the others follow."""
        return 1 + len(self.tips)

    @property
    def carried(self) -> Iterator[tuple[str, int]]:
        """Each target's name, and the frame that carries it."""
        return zip(self.targets, self.carrier[self.first_target :].tolist(), strict=True)

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


def ends_of_arms(mechanism: Mechanism, attachments: Attachments) -> tuple[Tip, ...]:
    """The first tip, and the end of each further branch that carries what is measured: the second arm's."""
    carrying = {attachments.frames[frame] for frame in attachments.carrier[attachments.led]}
    first, *others = mechanism.tips
    # A link further down the same arm is no arm of its own.
    same = (BASE, *mechanism.path(first.joint))
    return (first, *(tip for tip in others if tip.link in carrying and tip.joint not in same))


def attach(
    mechanism: Mechanism,
    led_links: Sequence[str | None],
    targets: Sequence[Target],
    rig: Rig,
    mounts: Mapping[str, CameraMount],
    parts: Sequence[str] = ("",),
) -> Attachments:
    """Sort LEDs, targets and cameras by what they are attached to.

    Args:
        mechanism: the robot.
        led_links: a link for each LED, or "world"; None for the tip link.
        targets: rigid bodies with points.
        rig: the cameras.
        mounts: of the eye-in-hand ones, by name.
        parts: the names of the session's parts.

    Raises:
        RobotError: a link is none of the mechanism's tips.
        SessionError: there is nothing to see, or nothing is on the robot, a camera's pose is given by one in another
            frame, or on its link though its reference camera gives it there.
    """
    if not led_links and not targets:
        raise SessionError("there is neither an LED nor a target", remedy="Name at least one.")
    check_names("targets", [target.name for target in targets])
    led_at, target_at = ([link or mechanism.tip_link for link in of] for of in (led_links, [t.link for t in targets]))
    camera_at = [mounts[name].link if name in mounts else WORLD for name in rig.names]
    names = list(dict.fromkeys([WORLD, *led_at, *target_at, *camera_at]))
    led, carrier, camera = ([names.index(link) for link in links] for links in (led_at, target_at, camera_at))
    for t, target in enumerate(targets):
        led += [len(names) + t] * len(target.points)
    together = list(zip(camera, rig.group, strict=True))
    reference = [together.index(of) for of in together]
    if len(names) == 1:
        raise SessionError("no LED, target or camera is on the robot", remedy="Name the link that carries one.")
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
        tuple(target.name for target in targets),
        frozen([*range(len(names)), *carrier], np.intp),
        frozen(led, np.intp),
        frozen(np.concatenate([np.zeros((0, 3)), *(target.points for target in targets)])),
        tuple(rig.names),
        frozen(camera, np.intp),
        frozen(reference, np.intp),
        tuple(T_cam_reference),
        tuple(T_reference_frame),
        frozen(rig.lens, np.intp),
        tuple(parts),
    )
