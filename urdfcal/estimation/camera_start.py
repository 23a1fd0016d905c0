"""Place cameras by PnP on the nominal arm's LED positions, and LEDs where the cameras' rays meet (METHOD 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, inverse
from urdfcal.errors import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.estimation.measurements.pixels import Detections
    from urdfcal.estimation.start import Start
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Session

_ENOUGH = 6
# PnP on LED positions that are only roughly known (the LED may sit 0.1 m off the tip, 1 m away): outliers are
# what is farther off than this. [rad]
_PNP_TOLERANCE = 0.1
# Rays whose normal equations are worse conditioned meet nowhere in particular.
_MEETING = 1e6


@dataclass(frozen=True, eq=False)
class Views:
    """What the cameras saw, and where the links that carry LEDs and cameras were.

    Where methods take ``T_world_base``, it is (N, 4, 4), of every pose of the session.

    Attributes:
        at: the session, and where the links of the nominal arm are.
        detections: of the session.
        state: where the targets are, as far as that is known.
    """

    at: Start
    detections: Detections
    state: State

    @property
    def session(self) -> Session:
        """The cameras, and what is attached where."""
        return self.at.session

    @property
    def _at_base(self) -> Floats:
        """T_world_base (N, 4, 4) of a world that is the base link."""
        return np.broadcast_to(np.eye(4), (len(self.session.poses), 4, 4))

    def base(self, T_cam_frame: Sequence[Floats | None], leds: Floats) -> Floats:
        """T_world_base by PnP of the eye-to-hand camera of known pose that sees most; the first one's is known."""
        seen = np.bincount(self.detections.camera, minlength=len(T_cam_frame))
        places = {c: T for c in self.session.attachments.eye_to_hand if (T := T_cam_frame[c]) is not None}
        c = max(places, key=lambda c: int(seen[c]))
        return inverse(places[c]) @ self.resect(int(c), self._at_base, leds)

    def place(self, c: int, T_world_base: Floats, leds: Floats, by_reference: Floats | None) -> Floats:
        """T_cam_frame of a camera of unknown pose: by its reference camera, else by PnP."""
        if by_reference is not None:
            return by_reference
        if not np.any(self.detections.camera == c):
            return np.eye(4)  # a camera that sees nothing may be anywhere
        return self.resect(c, T_world_base, leds)

    def meet(self, T_world_base: Floats, T_cam_frame: Sequence[Floats | None], leds: Floats, wanted: Bools) -> Floats:
        """Put LEDs (L + M, 3) where the rays that see them meet: least squares in their frames, robust to no outlier.

        An LED that is not wanted, or whose rays are too few, stays where it is.
        """
        detections, attachments = self.detections, self.session.attachments
        leds = leds.copy()
        for index in np.intersect1d(np.flatnonzero(wanted), detections.led):
            A, b = np.zeros((3, 3)), np.zeros(3)
            for c, lens in enumerate(self.session.rig.cameras):
                rows = np.flatnonzero((detections.led == index) & (detections.camera == c))
                T_cam = T_cam_frame[c]
                if T_cam is None or not len(rows):
                    continue
                rays = lens.unproject(detections.uv[rows])
                good = np.isfinite(rays[:, 0])
                rays, pose = rays[good], detections.pose[rows[good]]
                T = T_cam @ self._between(pose, int(attachments.led[index]), int(attachments.camera[c]), T_world_base)
                rays /= np.linalg.norm(rays, axis=1, keepdims=True)
                across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
                A += np.sum(np.swapaxes(T[:, :3, :3], 1, 2) @ across @ T[:, :3, :3], axis=0)
                b -= np.sum((np.swapaxes(T[:, :3, :3], 1, 2) @ across @ T[:, :3, 3, None])[..., 0], axis=0)
            if np.linalg.cond(A) < _MEETING:
                leds[index] = np.linalg.solve(A, b)
        return leds

    def miss(self, c: int, leds: Floats) -> float:
        """How far (median, px) a camera sees the LEDs from where they are, the camera put where that is least.

        Raises:
            CalibrationError: there is no such place.
        """
        T_cam = self.resect(c, self._at_base, leds)
        rows, T = self._placed(c, self._at_base)
        p_cam = (T_cam @ T @ np.insert(leds[self.detections.led[rows]], 3, 1.0, axis=1)[..., None])[:, :3, 0]
        uv = self.session.rig.cameras[c].project(p_cam)
        distance = np.linalg.norm(uv - self.detections.uv[rows], axis=1)
        return float(np.median(np.where(np.isfinite(distance), distance, np.inf)))

    def _placed(self, c: int, T_world_base: Floats) -> tuple[Ints, Floats]:
        """A camera's detections of LEDs of roughly known position: rows, and T_view_led (S, 4, 4) of their frames."""
        frames, d = self.session.attachments, self.detections
        given = self.at.placed(self.state)
        carrier = frames.carrier[frames.led]
        # Where an LED stands in the world is known at most where the world is the base; a target without its pose is
        # nowhere.
        known = np.where(frames.led < frames.first_target, carrier != 0, (carrier != 0) & given)
        known |= given & (frames.camera[c] != 0)
        mine = np.flatnonzero((d.camera == c) & known[d.led])
        T = np.empty((len(mine), 4, 4))
        for frame in np.unique(frames.led[d.led[mine]]):
            here = frames.led[d.led[mine]] == frame
            T[here] = self._between(d.pose[mine[here]], int(frame), int(frames.camera[c]), T_world_base)
        return mine, T

    def _between(self, pose: Ints, led_frame: int, view_frame: int, T_world_base: Floats) -> Floats:
        """T_view_led (S, 4, 4) of the frames that an LED and a camera are fixed in."""
        return inverse(self._frame(pose, view_frame, T_world_base)) @ self._frame(pose, led_frame, T_world_base)

    def _frame(self, pose: Ints, frame: int, T_world_base: Floats) -> Floats:
        return self.at.frame(frame, pose, self.state, T_world_base)

    def resect(self, camera: int, T_world_base: Floats, leds: Floats) -> Floats:
        """The camera's place in its frame (4, 4) by PnP on the nominal arm's LED positions."""
        import cv2

        d = self.detections
        lens = self.session.rig.cameras[camera]
        mine, T = self._placed(camera, T_world_base)
        rays = lens.unproject(d.uv[mine])[:, :2]
        objects = T[:, :3, 3] + (T[:, :3, :3] @ leds[d.led[mine]][..., None])[..., 0]
        good = np.isfinite(rays[:, 0])
        if good.sum() < _ENOUGH:
            raise CalibrationError(
                f"camera {lens.name!r} has only {good.sum()} detections of LEDs whose position is roughly known: six "
                "or more are needed to place it",
                remedy="Measure more poses in its view, give its place, or the LEDs'.",
            )
        try:
            found, rvec, tvec, _ = cv2.solvePnPRansac(
                objects[good], rays[good], np.eye(3), None, reprojectionError=_PNP_TOLERANCE, flags=cv2.SOLVEPNP_SQPNP
            )
        except cv2.error:  # points that hardly differ
            found = False
        if not found:
            raise CalibrationError(
                f"camera {lens.name!r} cannot be placed from its detections",
                remedy="Check its intrinsics and that the detections are of this robot's LEDs.",
            )
        T_cam = np.eye(4)
        T_cam[:3, :3] = cv2.Rodrigues(rvec)[0]
        T_cam[:3, 3] = tvec.ravel()
        return T_cam
