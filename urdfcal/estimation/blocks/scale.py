"""The unit of the instrument's lengths as an unknown: a printed board's, or a tracker's."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.blocks.base import VectorBlock
from urdfcal.estimation.state import Key

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.estimation.state import State

SCALE: Key[Floats] = Key("scale")
"""(1,) share that the instrument's lengths are too long by."""


class ScaleBlock(VectorBlock):
    """The share that baselines, or a tracker's points, are too long by, known to a standard deviation."""

    order: ClassVar[int] = 3
    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, sigma: float) -> ScaleBlock:
        """Take what is said of it; exact if that is 0."""
        return cls(
            key=SCALE,
            names=("scale",),
            units=("1",),
            nominal=np.zeros(1),
            sigma=np.array([sigma if sigma > 0.0 else np.inf]),
            fixed={} if sigma > 0.0 else {0: "it is given as exact"},
            phrase="the scale of what measured",
        )


def scale_of(state: State) -> float:
    """Return the factor 1 + scale of a state; 1 where it is no unknown."""
    return 1.0 + float(state[SCALE][0]) if SCALE in state else 1.0
