"""Where one camera should see the LEDs: the arm as drawn, put before the camera by what most images show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.cameras.rig import by_motion, small_motion
from urdfcal.detection.spots.gaussian import Rows

if TYPE_CHECKING:
    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.cameras.camera import Camera
    from urdfcal.session.knowledge import Led

# Six images fix a camera's pose twice over.
FEWEST = 6
# If the brightest light fits the arm in fewer images than this, it is not known which light is the arm's.
_MOST = 0.5
# Where the brightest do not, any of the three brightest may be the arm's: of 500 triples of lights, 18 are the LED's
# if every image has two reflections. Chance explains more of three lights than of one: more images are asked for.
_LIGHTS, _TRIPLES, _MOST_OF_SEVERAL = 3, 500, 0.7
# A mirrored LED turns the wrong way round: the drawn arm explains it several times worse than the LED, if at all.
_CLEARER = 3.0
# How far off the arm as drawn may be before anything is fitted: 2 cm at 1 m. [rad]
_DRAWN = 0.02
# Where an LED sits if nobody says: within a hand of its link's origin. [m]
_UNKNOWN_LED, _RULER = 0.15, 0.005
# The arm as drawn is wrong by millimetres, which are as many pixels a metre away; their spread is measured in the
# images, and the gate is this many times their median. Of 5,200 LEDs of simulated arms, most of them before cameras on
# the arm, it leaves out 4, in sessions of six poses; four medians leave out 31.
_GATE, _ALLOWANCE = 6.0, 3.0
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
        gate: (P,) how far from there it may be. [px]
    """

    uv: Floats
    gate: Floats

    def misses(self, lights: Lights) -> Floats:
        """How far (n,) lights are from where the LED should be, px; infinite where it cannot be."""
        distance = np.linalg.norm(lights.uv - self.uv[lights.image], axis=1)
        return np.where(np.isfinite(distance), distance, np.inf)

    def near(self, lights: Lights) -> Bools:
        """Which of (n,) lights are where the LED should be."""
        return self.misses(lights) <= self.gate[lights.image]


def predict(
    camera: Camera, leds: tuple[Led, ...], T_mount_link: Floats, led: Ints, lights: Lights
) -> Prediction | None:
    """Place the camera before the arm as drawn, from lights of which most are the LED's.

    The brightest light of each image is taken for the LED's first. Where these disagree with the arm, reflections may
    outshine the LED: then the lights that move as the arm does are the LED's, unless others do so as well.

    Args:
        camera: its lens.
        leds: of the session.
        T_mount_link: (P, 4, 4) of every image: the link of its LED in the frame that carries the camera, by the arm as
            drawn. [m]
        led: (P,) which one is lit.
        lights: that may be LEDs.

    Returns:
        None where the images are too few, or do not agree with the arm.
    """
    places = np.array([np.zeros(3) if one.position is None else one.position for one in leds])
    sigma = np.array([_UNKNOWN_LED if one.position is None else one.sigma or _RULER for one in leds])
    lights = lights[np.isfinite(camera.unproject(lights.uv)[:, 0])]
    first = _first(lights.image, -lights.flux)
    if len(first) < FEWEST:
        return None
    off = _DRAWN + float(np.max(sigma[np.unique(led[lights.image[first]])]))
    unplaced = _Fit(camera, T_mount_link, led, np.eye(4), places, places, np.maximum(sigma, 1e-4))
    T_cam_mount = _placed(unplaced, lights[first], off)
    if T_cam_mount is not None:
        found = _refined(replace(unplaced, T_cam_mount=T_cam_mount), lights, off, _MOST)
        if found is not None:
            return found
    return _predicted_by_motion(unplaced, _brightest(lights), off)


def _placed(fit: _Fit, lights: Lights, off: float) -> Floats | None:
    """T_cam_mount (4, 4) by which the arm explains most of ``lights``, one an image, to within ``off`` rad."""
    import cv2

    rays, objects = fit.camera.unproject(lights.uv)[:, :2], fit.in_mount()[lights.image]
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        objects, rays, np.eye(3), None, reprojectionError=off, iterationsCount=300, flags=cv2.SOLVEPNP_SQPNP
    )
    if not found or inliers is None or len(inliers) < max(FEWEST, _MOST * len(lights.image)):
        return None
    return small_motion(np.concatenate([translation.ravel(), rotation.ravel()]))


def _predicted_by_motion(fit: _Fit, lights: Lights, off: float) -> Prediction | None:
    """Predict from the lights that move as the arm does; None if two lights an image do, or none."""
    found: list[Prediction] = []
    rest = lights
    for _ in range(2):
        T_cam_mount = _placed_by_triples(fit, rest, off)
        if T_cam_mount is None:
            break
        prediction = _refined(replace(fit, T_cam_mount=T_cam_mount), rest, off, _MOST_OF_SEVERAL)
        if prediction is None:
            break
        found.append(prediction)
        rest = rest[~prediction.near(rest)]
    found.sort(key=lambda prediction: np.median(prediction.gate))
    if not found or (len(found) > 1 and np.median(found[1].gate) < _CLEARER * np.median(found[0].gate)):
        return None
    return found[0]


def _placed_by_triples(fit: _Fit, lights: Lights, off: float) -> Floats | None:
    """T_cam_mount (4, 4) by which the arm explains a light in most images, of which each may have several."""
    import cv2

    images, of = np.unique(lights.image, return_inverse=True)
    least = max(FEWEST, _MOST_OF_SEVERAL * len(images))
    rng = np.random.default_rng(0)
    rays, objects = fit.camera.unproject(lights.uv)[:, :2], fit.in_mount()[lights.image]
    best, most = None, 0
    for _ in range(_TRIPLES if len(images) >= FEWEST else 0):
        rows = [rng.choice(np.flatnonzero(of == i)) for i in rng.choice(len(images), 3, replace=False)]
        _, rotations, translations = cv2.solveP3P(objects[rows], rays[rows], np.eye(3), None, cv2.SOLVEPNP_AP3P)
        for rotation, translation in zip(rotations, translations, strict=True):
            T = small_motion(np.concatenate([translation.ravel(), rotation.ravel()]))
            points = objects @ T[:3, :3].T + T[:3, 3]
            ahead = np.maximum(points[:, 2:], 1e-9)
            near = (points[:, 2] > 0.0) & (np.linalg.norm(points[:, :2] / ahead - rays, axis=1) < off)
            count = np.unique(of[near]).size
            if count > most:
                best, most = T, count
    return best if most >= least else None


def _refined(fit: _Fit, lights: Lights, off: float, share: float) -> Prediction | None:
    """Fit to the lights nearest to where they should be; None if these are in less than a ``share`` of the images."""
    camera = fit.camera
    least = np.full(len(fit.led), np.inf)
    for _ in range(_ROUNDS):
        points = fit.points()
        distance = np.linalg.norm(points, axis=1)
        # The same millimetres are more pixels of an LED nearer to the camera.
        widest = off * float(camera.intrinsics[:2].mean()) / np.minimum(distance, 1.0)
        gate = np.minimum(widest, least)
        prediction = Prediction(camera.project(points), gate)
        misses = prediction.misses(lights)
        nearest = _first(lights.image, misses)
        near = nearest[misses[nearest] < gate[lights.image[nearest]]]
        if len(near) < max(FEWEST, share * len(nearest)):
            return None
        fit = fit.stepped(lights.image[near], lights.uv[near])
        spread = float(np.median(misses[near] * distance[lights.image[near]]))
        least = np.minimum(gate, _ALLOWANCE + _GATE * spread / distance)
    return Prediction(camera.project(fit.points()), least)


def _brightest(lights: Lights) -> Lights:
    """The few brightest lights of each image."""
    order = np.lexsort([-lights.flux, lights.image])
    image = lights.image[order]
    return lights[order[np.arange(len(image)) - np.searchsorted(image, image) < _LIGHTS]]


def _first(image: Ints, key: Floats) -> Ints:
    """The light with the smallest ``key`` of each image that has one."""
    order = np.lexsort([key, image])
    _, first = np.unique(image[order], return_index=True)
    return np.asarray(order[first])


@dataclass(frozen=True, eq=False)
class _Fit:
    """Camera pose and LED places that explain where the lights are, as far as the drawn arm allows."""

    camera: Camera
    T_mount_link: Floats
    led: Ints
    T_cam_mount: Floats
    leds: Floats
    declared: Floats
    sigma: Floats

    def in_mount(self) -> Floats:
        """(P, 3) the LEDs in the frame that carries the camera, m."""
        R, p = self.T_mount_link[:, :3, :3], self.T_mount_link[:, :3, 3]
        return np.asarray(p + (R @ self.leds[self.led][..., None])[..., 0])

    def points(self) -> Floats:
        """(P, 3) the LEDs in the camera's frame, m."""
        return np.asarray(self.in_mount() @ self.T_cam_mount[:3, :3].T + self.T_cam_mount[:3, 3])

    def stepped(self, image: Ints, uv: Floats) -> _Fit:
        """One robust Gauss-Newton step towards lights ``uv`` (m, 2) in images (m,)."""
        points = self.points()[image]
        seen, J_point = self.camera.project_with_jacobian(points)
        r = uv - seen
        miss = np.linalg.norm(r, axis=1)
        scale = max(float(np.median(miss)), 0.1)
        weight = 1.0 / (scale * np.maximum(1.0, miss / (2.0 * scale)))
        turned = J_point @ (self.T_cam_mount[:3, :3] @ self.T_mount_link[image, :3, :3])
        lit = self.led[image][:, None] == np.arange(len(self.leds))
        J_leds = (turned[:, :, None] * lit[:, None, :, None]).reshape(len(uv), 2, -1)
        J = np.concatenate([by_motion(J_point, points), J_leds], axis=-1) * weight[:, None, None]
        prior = np.concatenate([np.zeros(6), np.repeat(self.sigma**-2.0, 3)])
        pull = prior * np.concatenate([np.zeros(6), (self.declared - self.leds).ravel()])
        H = np.einsum("mdi,mdj->ij", J, J) + np.diag(prior + 1e-6)
        step = np.linalg.solve(H, np.einsum("mdi,md->i", J, r * weight[:, None]) + pull)
        T = small_motion(step[:6]) @ self.T_cam_mount
        return replace(self, T_cam_mount=T, leds=self.leds + step[6:].reshape(-1, 3))
