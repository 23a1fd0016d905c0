"""The parts of the result document that say how far the arm is off: at the tip, and in poses that were left out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from urdfcal.estimation.evidence import TipError
    from urdfcal.estimation.left_out import LeftOut


def tip_section(tip: TipError) -> dict[str, Any]:
    """Return what error of the tip is expected, what more poses would bring, and what of it is the arm's size. [mm]."""
    with_more = None if tip.rms_with_more is None else 1e3 * tip.rms_with_more
    return {
        "rms_mm": 1e3 * tip.rms,
        "interval_mm": [1e3 * end for end in tip.interval],
        "more": {"poses": tip.more, "rms_mm": with_more},
        "size": {
            "sigma": tip.size.sigma,
            "rms_mm": 1e3 * tip.size.rms,
            "rms_without_mm": 1e3 * tip.size.rms_without,
            "is_limit": tip.limited_by_size,
        },
    }


def left_out_section(found: LeftOut | None) -> dict[str, Any]:
    """Return the part of the validation about poses that were left out; nothing where there are none. [mm]."""
    if found is None:
        return {}
    return {"left_out": {"poses": found.poses, "rms_mm": 1e3 * found.rms, "max_mm": 1e3 * found.largest}}
