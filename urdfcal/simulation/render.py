"""Rendering of lights on a sensor, electron by electron.

The chain is the usual one (EMVA 1288): expected electrons per pixel, a Poisson number of them, Gaussian read noise,
division by the gain, an offset, rounding, clipping.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Floats, Ints, frozen
from urdfcal.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

# A light is drawn as far as it reaches 1e-8 of its peak: less than an electron of the brightest.
_REACH = 6.1
# A streak is a row of spots this fraction of their width apart: its ripple is below 1e-9.
_STREAK_STEP = 0.5


@dataclass(frozen=True)
class Sensor:
    """A sensor that turns electrons into counts.

    Attributes:
        resolution: (width, height) in px.
        bits: of a pixel; more than 8 are stored in 16.
        electrons_per_count: inverse gain. [electrons]
        read_noise: one standard deviation. [electrons]
        black: value of a pixel without light. [counts]
    """

    resolution: tuple[int, int]
    bits: int = 8
    electrons_per_count: float = 10.0
    read_noise: float = 3.0
    black: float = 4.0

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 16 or self.electrons_per_count <= 0.0 or self.read_noise < 0.0:
            raise CameraError(f"there is no such sensor: {self}")

    @property
    def white(self) -> int:
        """The largest value of a pixel, in counts."""
        return int(2**self.bits - 1)

    @property
    def full_well(self) -> float:
        """Electrons at which a pixel saturates."""
        return (self.white - self.black) * self.electrons_per_count

    def expose(self, electrons: Floats, rng: np.random.Generator) -> NDArray[Any]:
        """Take an image: expected ``electrons`` (..., height, width) -> counts, uint8 or uint16."""
        collected = rng.poisson(electrons) + self.read_noise * rng.standard_normal(electrons.shape, dtype=np.float32)
        counts = np.rint(collected / self.electrons_per_count + self.black)
        return np.clip(counts, 0, self.white).astype(np.uint8 if self.bits <= 8 else np.uint16)


@dataclass(frozen=True, eq=False)
class Light:
    """A light whose image is a Gaussian spot, smeared evenly along ``motion`` while the shutter is open.

    Attributes:
        uv: (2,) its centre, that of the exposure if it moves. [px]
        peak: electrons per pixel area at the centre of the spot, at rest and without vignetting.
        sigma: of the spot, before pixels integrate over it. [px]
        motion: (2,) how far it moves during the exposure. [px]
    """

    uv: Floats
    peak: float
    sigma: float
    motion: Floats = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        object.__setattr__(self, "uv", frozen(self.uv))
        object.__setattr__(self, "motion", frozen(self.motion))


@dataclass(frozen=True, eq=False)
class Scenery:
    """What does not change between the images of a camera.

    Attributes:
        background: (height, width) expected electrons, vignetted.
        vignette: (height, width) share of the light that arrives.
        hot: (H, 2) pixels (column, row) that leak.
        leak: (H,) electrons that they leak.
    """

    background: Floats
    vignette: Floats
    hot: Ints
    leak: Floats

    @classmethod
    def flat(
        cls,
        resolution: tuple[int, int],
        level: float,
        slope: tuple[float, float] = (0.0, 0.0),
        vignetting: float = 0.0,
        lights: Sequence[Light] = (),
        hot: Ints | None = None,
        leak: Floats | None = None,
    ) -> Scenery:
        """Make a background that rises evenly, darkens towards the corners and holds lamps.

        Args:
            resolution: (width, height) in px.
            level: electrons in the middle of the image.
            slope: electrons per px along u and v.
            vignetting: share of the light that is lost in the corners.
            lights: that are static.
            hot: (H, 2) pixels (column, row) that leak.
            leak: (H,) electrons that they leak.
        """
        width, height = resolution
        u, v = np.arange(width) - (width - 1) / 2.0, np.arange(height)[:, None] - (height - 1) / 2.0
        vignette = 1.0 - vignetting * (u**2 + v**2) * 4.0 / (width**2 + height**2)
        background: Floats = np.maximum(level + slope[0] * u + slope[1] * v, 0.0) * vignette
        for light in lights:
            add_light(background, light, vignette)
        none = np.zeros((0, 2), dtype=np.intp)
        return cls(background, vignette, none if hot is None else hot, np.zeros(0) if leak is None else leak)

    def expected(self, lights: Sequence[Light]) -> Floats:
        """Expected electrons (height, width) with ``lights`` on."""
        electrons: Floats = self.background.copy()
        for light in lights:
            add_light(electrons, light, self.vignette)
        np.add.at(electrons, (self.hot[:, 1], self.hot[:, 0]), self.leak)
        return electrons


def add_light(electrons: Floats, light: Light, vignette: Floats | None = None) -> None:
    """Add a light to ``electrons`` (height, width) in place; what falls outside is lost."""
    length = float(np.linalg.norm(light.motion))
    steps = 1 + int(np.ceil(length / (_STREAK_STEP * light.sigma)))
    shares = (np.arange(steps) + 0.5) / steps - 0.5
    total = 2.0 * np.pi * light.sigma**2 * light.peak / steps
    for share in shares:
        centre = light.uv + share * light.motion
        u, of_u = _profile(float(centre[0]), light.sigma, electrons.shape[1])
        v, of_v = _profile(float(centre[1]), light.sigma, electrons.shape[0])
        spot = total * of_v[:, None] * of_u
        electrons[v, u] += spot if vignette is None else spot * vignette[v, u]


def _profile(centre: float, sigma: float, size: int) -> tuple[slice, Floats]:
    """Return the pixels along one axis that a spot reaches, and the share of it that falls into each."""
    from scipy.special import ndtr

    reach = _REACH * sigma + 1.0
    first, last = max(0, int(np.floor(centre - reach))), min(size, int(np.ceil(centre + reach)) + 1)
    edges = (np.arange(first, max(first, last) + 1) - 0.5 - centre) / sigma
    share: Floats = np.diff(ndtr(edges))
    return slice(first, max(first, last)), share
