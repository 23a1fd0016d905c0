"""What speaks against an estimate's unit of length: it contradicts the arm, or nothing tells it (METHOD 14)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.estimation.evidence import TipError
    from urdfcal.estimation.scale import LengthScale

# A scale that far from none is a mistake; between the two it is one or a strange arm. Standard deviations of the common
# factor under the tolerances: on common arms three are 0.35 to 0.7 %, 2 to 4 mm at the tip.
_DOUBTFUL_SCALE, _IMPOSSIBLE_SCALE = 3.0, 5.0
# What held-out poses show is read as what the arm is worth: the factor that they cannot show may not be this many times
# as much without a word. ur5_handeye: 8 times; rigs with two cameras, boards or sockets: 0.2 to 1.4 times.
_HIDDEN = 2.0
_LENGTHS = {
    "instrument": "the stereo baseline, or the size of the board that it was calibrated with",
    "distances": "the distances that are given as known",
}
_WANTED = {
    "instrument": "a larger board, a second camera or a known distance (led_distances) would tell it",
    "distances": "give longer distances, or ones that are known better",
    "nothing": "add a known length to session.yaml: led_distances, place_distances or a printed board (targets)",
}


def impossible(scale: LengthScale) -> Iterator[str]:
    """All lengths come out longer or shorter by one factor, far beyond what the tolerances allow."""
    yield from _contradicted(scale, _IMPOSSIBLE_SCALE, np.inf)


def doubtful(scale: LengthScale) -> Iterator[str]:
    """All lengths come out longer or shorter by one factor, beyond what the tolerances allow."""
    yield from _contradicted(scale, _DOUBTFUL_SCALE, _IMPOSSIBLE_SCALE)


def _contradicted(scale: LengthScale, least: float, most: float) -> Iterator[str]:
    if least < scale.sigmas <= most:
        yield (
            f"all lengths come out {1e2 * abs(scale.factor):.2g} +- {1e2 * scale.sigma:.1g} % too "
            f"{'long' if scale.factor > 0.0 else 'short'} for the arm's tolerances: check {_LENGTHS[scale.unit]}; "
            f"0.1 % is {1e3 * scale.tip_per_permille:.2g} mm at the tip"
        )


def unknown_size(tip: TipError, scale: LengthScale, held_out: float) -> Iterator[str]:
    """The arm's size is known so badly that held-out poses, which do not show it, promise too much.

    Whoever declares how well the scale is known need not be told.

    Args:
        tip: its expected error.
        scale: whose unit the lengths have.
        held_out: rms distance on poses or in regions not seen. [m]
    """
    if scale.declared is None and tip.limited_by_size and tip.size.rms > _HIDDEN * held_out:
        yield (
            f"all lengths together are known to {1e2 * tip.size.sigma:.2g} % only, {1e3 * tip.size.rms:.2g} of the "
            f"{1e3 * tip.rms:.2g} mm expected at the tip, and held-out poses ({1e3 * held_out:.2g} mm) do not show it; "
            f"{_WANTED[scale.unit]}"
        )
