"""How well a light's centre can be known at best, from the model that images are rendered with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.simulation.render import Light, Sensor, add_light

if TYPE_CHECKING:
    from urdfcal.arrays import Floats


def variance(sensor: Sensor, electrons: Floats) -> Floats:
    """Variance (electrons²) of what is read of expected ``electrons``: shot, read and rounding noise."""
    return electrons + sensor.read_noise**2 + sensor.electrons_per_count**2 / 12.0


def centroid_bound(sensor: Sensor, light: Light, background: float = 0.0, half: int = 24) -> float:
    """The Cramer-Rao bound of a spot's centre, all else (peak, size, background, its slope) unknown too.

    Saturated pixels say nothing.

    Args:
        sensor: that takes the image.
        light: at rest.
        background: electrons around it.
        half: the window reaches this many pixels to either side.

    Returns:
        The root of the mean of the two variances, of u and of v. [px]
    """
    pixels = np.arange(-half, half + 1)
    fraction = light.uv - np.rint(light.uv)

    def spot(values: Floats) -> Floats:
        u, v, peak, s = values
        electrons = np.zeros((pixels.size, pixels.size))
        add_light(electrons, Light(np.array([u + half, v + half]), peak, s))
        return electrons

    values = np.array([*fraction, light.peak, light.sigma])
    steps = np.array([1e-4, 1e-4, 1e-4 * light.peak, 1e-4])
    J = [(spot(values + h) - spot(values - h)) / (2.0 * h.sum()) for h in np.diag(steps)]
    ones = np.ones((pixels.size, pixels.size))
    J += [ones, ones * pixels / half, ones * pixels[:, None] / half]
    electrons = spot(values) + background
    weight = (electrons < sensor.full_well) / variance(sensor, electrons)
    A = np.array([j.ravel() for j in J])
    covariance = np.linalg.inv((A * weight.ravel()) @ A.T)
    return float(np.sqrt((covariance[0, 0] + covariance[1, 1]) / 2.0))
