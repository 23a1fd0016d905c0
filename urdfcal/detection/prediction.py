"""Where one camera should see the LEDs: the arm as drawn, put before the camera by what most images show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.cameras.rig import by_motion, small_motion
from urdfcal.detection.spots.gaussian import Rows

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.cameras.camera import Camera
    from urdfcal.session.knowledge import Led

# Six images fix a camera's pose twice over.
_FEWEST = 6
# If the brightest light fits the arm in fewer images than this, it is not known which light is the arm's.
_MOST = 0.5
# How far off the arm as drawn may be before anything is fitted: 2 cm at 1 m. [rad]
_DRAWN = 0.02
# Where an LED sits if nobody says: within a hand of the tip. [m]
_UNKNOWN_LED, _RULER = 0.15, 0.005
# The arm as drawn is wrong by millimetres, which are as many pixels; their spread is measured in the images, and
# the gate is this many times their median, which leaves out one in a thousand.
_GATE, _ALLOWANCE = 4.0, 3.0
_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Lights(Rows):
    """What one camera saw: n lights in P images.

    Attributes:
        image: (n,) index of the image.
        uv: (n, 2) where. [px]
        flux: (n,) how bright.
    """

    image: Ints
    uv: Floats
    flux: Floats


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where the LED should be in each of P images of a camera.

    Attributes:
        uv: (P, 2) NaN where it should be out of sight. [px]
        gate: how far from there it may be. [px]
    """

    uv: Floats
    gate: float

    def misses(self, lights: Lights) -> Floats:
        """How far (n,) lights are from where the LED should be, px; infinite where it cannot be."""
        distance = np.linalg.norm(lights.uv - self.uv[lights.image], axis=1)
        return np.where(np.isfinite(distance), distance, np.inf)


def predict(camera: Camera, leds: tuple[Led, ...], T_base_tip: Floats, led: Ints, lights: Lights) -> Prediction | None:
    """Place the camera before the arm as drawn, from lights of which most are the LED's.

    Args:
        camera: its lens.
        leds: on the tip link.
        T_base_tip: (P, 4, 4) of every image, of the arm as drawn. [m]
        led: (P,) which one is lit.
        lights: that may be LEDs.

    Returns:
        None where the images are too few, or do not agree with the arm.
    """
    import cv2

    places = np.array([np.zeros(3) if one.position is None else one.position for one in leds])
    sigma = np.array([_UNKNOWN_LED if one.position is None else one.sigma or _RULER for one in leds])
    first = _first(lights.image, -lights.flux)
    rays = camera.unproject(lights.uv[first])[:, :2]
    first, rays = first[np.isfinite(rays[:, 0])], rays[np.isfinite(rays[:, 0])]
    if len(first) < _FEWEST:
        return None
    at = lights.image[first]
    tips = T_base_tip[at]
    objects = tips[:, :3, 3] + (tips[:, :3, :3] @ places[led[at]][..., None])[..., 0]
    off = _DRAWN + float(np.max(sigma[np.unique(led[at])]))
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        objects, rays, np.eye(3), None, reprojectionError=off, iterationsCount=300, flags=cv2.SOLVEPNP_SQPNP
    )
    if not found or inliers is None or len(inliers) < max(_FEWEST, _MOST * len(first)):
        return None
    T_cam_base = small_motion(np.concatenate([translation.ravel(), rotation.ravel()]))
    fit = _Fit(camera, T_base_tip, led, T_cam_base, places, places, np.maximum(sigma, 1e-4))
    gate = off * float(camera.intrinsics[:2].mean())
    for _ in range(_ROUNDS):
        prediction = Prediction(camera.project(fit.points()), gate)
        misses = prediction.misses(lights)
        nearest = _first(lights.image, misses)
        near = nearest[misses[nearest] < gate]
        if len(near) < max(_FEWEST, _MOST * len(nearest)):
            return None
        fit = fit.stepped(lights.image[near], lights.uv[near])
        gate = min(gate, _ALLOWANCE + _GATE * float(np.median(misses[near])))
    return Prediction(camera.project(fit.points()), gate)


def _first(image: Ints, key: Floats) -> Ints:
    """The light with the smallest ``key`` of each image that has one."""
    order = np.lexsort([key, image])
    _, first = np.unique(image[order], return_index=True)
    return np.asarray(order[first])


@dataclass(frozen=True, eq=False)
class _Fit:
    """Camera pose and LED places that explain where the lights are, as far as the drawn arm allows."""

    camera: Camera
    T_base_tip: Floats
    led: Ints
    T_cam_base: Floats
    leds: Floats
    declared: Floats
    sigma: Floats

    def points(self) -> Floats:
        """(P, 3) the LEDs in the camera's frame, m."""
        base = self.T_base_tip[:, :3, 3] + (self.T_base_tip[:, :3, :3] @ self.leds[self.led][..., None])[..., 0]
        return np.asarray(base @ self.T_cam_base[:3, :3].T + self.T_cam_base[:3, 3])

    def stepped(self, image: Ints, uv: Floats) -> _Fit:
        """One robust Gauss-Newton step towards lights ``uv`` (m, 2) in images (m,)."""
        points = self.points()[image]
        seen, J_point = self.camera.project_with_jacobian(points)
        r = uv - seen
        miss = np.linalg.norm(r, axis=1)
        scale = max(float(np.median(miss)), 0.1)
        weight = 1.0 / (scale * np.maximum(1.0, miss / (2.0 * scale)))
        turned = J_point @ (self.T_cam_base[:3, :3] @ self.T_base_tip[image, :3, :3])
        lit = self.led[image][:, None] == np.arange(len(self.leds))
        J_leds = (turned[:, :, None] * lit[:, None, :, None]).reshape(len(uv), 2, -1)
        J = np.concatenate([by_motion(J_point, points), J_leds], axis=-1) * weight[:, None, None]
        prior = np.concatenate([np.zeros(6), np.repeat(self.sigma**-2.0, 3)])
        pull = prior * np.concatenate([np.zeros(6), (self.declared - self.leds).ravel()])
        H = np.einsum("mdi,mdj->ij", J, J) + np.diag(prior + 1e-6)
        step = np.linalg.solve(H, np.einsum("mdi,md->i", J, r * weight[:, None]) + pull)
        T = small_motion(step[:6]) @ self.T_cam_base
        return replace(self, T_cam_base=T, leds=self.leds + step[6:].reshape(-1, 3))
