"""Places in the world as an unknown: points that never move and that something touches, or is measured from."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.blocks.base import VectorBlock
from urdfcal.estimation.state import Key

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.session.model import Session

PLACES: Key[Floats] = Key("places")
"""(P, 3) positions in the world of the places that a session's tables name. [m]"""


class PlacesBlock(VectorBlock):
    """The places' positions, without priors: whatever touches them says where they are."""

    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, session: Session, start: Floats) -> PlacesBlock:
        """Take the coordinates (P, 3) of all places; those that nothing measures are fixed where they are."""
        names, measured = session.named("place"), session.measured_of("place")
        return cls(
            key=PLACES,
            names=tuple(f"place {name}.{axis}" for name in names for axis in "xyz"),
            units=("m",) * (3 * len(names)),
            nominal=start,
            sigma=np.full(3 * len(names), np.inf),
            fixed={k: "nothing measures it" for k in range(3 * len(names)) if k // 3 not in measured},
            phrase="where the places are",
        )
