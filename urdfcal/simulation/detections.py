"""Simulated measurements of the LEDs in the images: their true pixels, noise, and outliers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.measurements import Detections

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.cameras.camera import Camera
    from urdfcal.simulation.scene import Scene

# From a blob found with a reflection in it, to the wrong blob. [px]
_OUTLIERS = (5.0, 200.0)


def simulate_detections(
    scene: Scene,
    q: Floats,
    views: Ints,
    *,
    pixel: float,
    sigma: float,
    outliers: float,
    noise_rng: np.random.Generator,
    outlier_rng: np.random.Generator,
) -> tuple[Detections, Ints]:
    """Detect the LEDs of a scene; what falls out of an image is missing.

    Args:
        scene: as it truly is.
        q: (N, n) true joint values of the poses. [rad or m]
        views: (N, K) the cameras that look at each pose.
        pixel: noise, one standard deviation. [px]
        sigma: the noise that the detections declare. [px]
        outliers: share of the detections that is moved by 5 to 200 px, within their images.
        noise_rng: the source of the noise.
        outlier_rng: the source of the outliers.

    Returns:
        The detections, and the rows (K,) of the outliers among them.
    """
    uv = scene.pixels(q)[np.arange(len(q))[:, None], views]
    uv = uv + pixel * noise_rng.standard_normal(uv.shape)
    inside = np.zeros(uv.shape[:-1], dtype=bool)
    for c, one in enumerate(scene.cameras):
        inside[views == c] = one.in_image(uv[views == c])
    pose, view, led = np.nonzero(inside)
    camera, uv = views[pose, view], uv[inside]
    rows = np.sort(outlier_rng.choice(len(uv), round(outliers * len(uv)), replace=False))
    for row in rows:
        uv[row] = _moved(uv[row], scene.cameras[camera[row]], outlier_rng)
    return Detections(pose, camera, led, uv, np.array(sigma)), rows


def _moved(uv: Floats, camera: Camera, rng: np.random.Generator) -> Floats:
    """Return another pixel (2,) in the image."""
    while True:
        angle, distance = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*_OUTLIERS)
        moved: Floats = uv + distance * np.array([np.cos(angle), np.sin(angle)])
        if camera.in_image(moved):
            return moved
