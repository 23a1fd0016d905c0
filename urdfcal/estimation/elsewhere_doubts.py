"""What is to be doubted of an estimate where it was not measured, and whether it is better than the drawing there."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.estimation.evidence import Evidence, Regions
    from urdfcal.estimation.model_selection import Comparison
    from urdfcal.session.model import Session

# Poses of a left-out region are extrapolated to: clean simulated sessions show up to 1.6 times the error among poses.
_WORSE_ELSEWHERE = 2.0


def elsewhere(comparison: Comparison, regions: Regions) -> Iterator[str]:
    """Regions that were left out are predicted far worse than poses among the others."""
    inside = comparison.chosen.rms("distance")
    if regions.rms > _WORSE_ELSEWHERE * inside:
        found = f"{1e3 * regions.rms:.2g} mm rms in regions left out, {1e3 * inside:.2g} mm among the measured poses"
        low, high = (1e3 * end for end in regions.interval)
        if regions.interval[0] > inside:
            yield f"it does not hold elsewhere: {found}: use it where it was measured, or measure where it will be used"
        else:
            yield (
                f"it may not hold elsewhere: {found}, and a further region may show {low:.2g} to {high:.2g} mm (95 %): "
                "measure where it will be used, or use it where it was measured"
            )


def unimproved(session: Session, evidence: Evidence) -> Iterator[str]:
    """The calibrated arm is not shown to be better than the nominal one, on the measured poses or away from them."""
    low, high = (1e3 * end for end in evidence.improvement)
    if session.estimate.geometry == "none":
        return
    if low <= 0.0:
        yield (
            "no improvement over the nominal arm is shown: on held-out poses the difference is "
            f"{low:.2g} to {high:.2g} mm (95 %)"
        )
        return
    for tip in evidence.corrections:
        if tip.moved <= tip.expected:
            link = f"tip {tip.link}" if len(evidence.corrections) > 1 else "tip"
            yield (
                f"away from the measured poses the nominal arm may be as good: over the workspace the {link} moves by "
                f"{1e3 * tip.moved:.2g} mm rms, and is expected {1e3 * tip.expected:.2g} mm off (urdfcal plan)"
            )


def zeros_alone(session: Session) -> Iterator[str]:
    """What is not estimated counts as exact."""
    if session.estimate.geometry == "offsets":
        yield "the joints' zeros alone are estimated, as estimate says: errors of lengths and angles are not counted"
