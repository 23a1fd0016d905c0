"""Where the arm as drawn holds the LEDs of one camera's images, in the frame that the camera is fixed in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, inverse
from urdfcal.robot.kinematics import link_poses
from urdfcal.session.attachments import WORLD

if TYPE_CHECKING:
    from urdfcal.session.knowledge import Led
    from urdfcal.session.model import Positions

# The arm is in the same place again where its LED comes back to within this. [m]
_SAME = 5e-3
# Where an LED of unknown place is taken to be: somewhere off its link's origin, so that turning the link moves it. [m]
_ASSUMED = 0.05


@dataclass(frozen=True, eq=False)
class LedFrames:
    """The LEDs' links in each of P images of one camera, by the arm as drawn.

    Attributes:
        leds: of the session.
        led: (P,) which one is lit.
        T_mount_link: (P, 4, 4) its link in the frame that the camera is fixed in: a link's, or for a camera in the
            world the base link's. [m]
        known: (P,) False where the arm does not say where the LED is: it stands in a world whose place is not known.
    """

    leds: tuple[Led, ...]
    led: Ints
    T_mount_link: Floats
    known: Bools

    @property
    def places(self) -> Ints:
        """(P,) a number for each image that is the same where the camera should see the LED in the same place."""
        assumed = [np.full(3, _ASSUMED) if one.position is None else one.position for one in self.leds]
        R, p = self.T_mount_link[:, :3, :3], self.T_mount_link[:, :3, 3]
        points = p + (R @ np.array(assumed).reshape(-1, 3)[self.led][..., None])[..., 0]
        unplaced = np.array([one.position is None for one in self.leds], dtype=bool)[self.led] | ~self.known
        rounded = np.column_stack([np.round(points / _SAME), np.where(unplaced, self.led, -1)])
        return np.asarray(np.unique(rounded, axis=0, return_inverse=True)[1].ravel())


def frames_in_base(positions: Positions) -> Floats:
    """T_base_frame (F, N, 4, 4) of the world, taken for the base, and of the links that carry something. [m]."""
    links = link_poses(positions.chain, positions.q, positions.attachments.tips)
    return np.array([np.broadcast_to(np.eye(4), (len(positions.q), 4, 4)), *links])


def led_frames(positions: Positions, T_base_frame: Floats, camera: int, pose: Ints, led: Ints) -> LedFrames:
    """Sort out what carries the LED and what carries the camera in its images.

    Args:
        positions: the session.
        T_base_frame: (F, N, 4, 4) see :func:`frames_in_base`. [m]
        camera: index of the camera.
        pose: (P,) of each image.
        led: (P,) which one is lit.
    """
    attachments = positions.attachments
    of_led = attachments.led[led]
    T = inverse(T_base_frame[attachments.camera[camera], pose]) @ T_base_frame[of_led, pose]
    # Without eye-to-hand cameras the world is the base link's frame, see Attachments.
    known = (of_led != attachments.frames.index(WORLD)) | (len(attachments.eye_to_hand) == 0)
    return LedFrames(positions.leds, led, T, known)
