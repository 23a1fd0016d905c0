"""What files exports of a result have, by name."""

from __future__ import annotations

from pathlib import PurePath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


def exported(folder: Path, urdf_name: str) -> list[str]:
    """List what a folder holds of exports.

    Args:
        folder: of results.
        urdf_name: of the corrected URDF.
    """
    from urdfcal.output.exports.frames import LAUNCH
    from urdfcal.output.exports.tables import FRAMES, KINEMATICS, OFFSETS, ORIGINS, ROWS, TRANSMISSIONS
    from urdfcal.output.exports.vendors import FRANKA, LEROBOT

    stem = PurePath(urdf_name).stem
    urdfs = [f"{stem}_{what}.urdf" for what in ("frames", "without_offsets", "region")]
    names = [LAUNCH, ROWS, FRAMES, OFFSETS, TRANSMISSIONS, KINEMATICS, ORIGINS, FRANKA, LEROBOT, *urdfs]
    return [name for name in names if (folder / name).is_file()]
