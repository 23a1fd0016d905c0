"""Where the LEDs sit as an unknown: their positions on their links, or in the world."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.blocks.base import VectorBlock
from urdfcal.estimation.state import Key

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.session.knowledge import Led

LEDS: Key[Floats] = Key("leds")
"""(L, 3) LED positions, each in the frame that it is attached to. [m]"""

LED_TOLERANCE = 0.02
"""Standard deviation of an LED position given without one: a hand-held ruler on a gripper. [m]"""


class LedsBlock(VectorBlock):
    """The LEDs' positions, with what the session says of them as priors."""

    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, leds: Sequence[Led], start: Floats, *, priors: bool) -> LedsBlock:
        """Take the coordinates of all LEDs; those given as exact are fixed.

        Args:
            leds: as the session declares them.
            start: (L, 3) where a position that is not given is centred; it has no prior. [m]
            priors: whether given positions act as priors.
        """
        sigma = np.repeat([led_sigma(led) for led in leds], 3)
        given = [at if led.position is None else led.position for led, at in zip(leds, start, strict=True)]
        return cls(
            key=LEDS,
            names=tuple(f"{led.name}.{axis}" for led in leds for axis in "xyz"),
            units=("m",) * (3 * len(leds)),
            nominal=np.array(given).reshape(-1, 3),
            sigma=np.where((sigma > 0.0) & priors, sigma, np.inf),
            fixed={int(k): "its position is given as exact" for k in np.flatnonzero(sigma == 0.0)},
            phrase="where the LEDs sit",
        )


def led_sigma(led: Led) -> float:
    """Standard deviation of an LED's declared position; inf where none is declared. [m]."""
    if led.position is None:
        return float("inf")
    return LED_TOLERANCE if led.sigma is None else led.sigma


def led_positions(leds: Sequence[Led]) -> Floats:
    """Declared LED positions (L, 3), the origin of the link where none is declared. [m]."""
    return np.array([np.zeros(3) if led.position is None else led.position for led in leds]).reshape(-1, 3)
