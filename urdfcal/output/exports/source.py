"""What exports are made from: a saved calibration, and the corrected URDF beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.result.calibration import Calibration, corrected_name
from urdfcal.robot.chain import read_mechanism
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from pathlib import Path

# The URDF's angles round by less; an edited origin differs by more. [m, entries of the rotation]
_SAME = 1e-9


def corrected_urdf(calibration: Calibration, folder: Path) -> Urdf:
    """Read the corrected URDF that was written with a calibration.

    Args:
        calibration: as loaded.
        folder: of the results.

    Raises:
        OutputError: it is not there, or its origins are not the calibration's.
        RobotError: it is no valid URDF.
    """
    path = folder / corrected_name(calibration.to_dict()["robot"]["urdf"])
    if not path.is_file():
        raise OutputError(
            "the corrected URDF is not beside calibration.json",
            where=str(path),
            remedy="Name the folder that `urdfcal calibrate` wrote.",
        )
    urdf, chain = Urdf.read(path), calibration.chain
    found = read_mechanism(urdf, [tip.link for tip in chain.tips], chain.base_link)
    for name in (name for name in chain.names if name not in found.names):
        raise _edited(path, name)
    for name, T, built in zip(found.names, found.placements, calibration.placements, strict=True):
        if not np.allclose(T, built, rtol=0.0, atol=_SAME):
            raise _edited(path, name)
    return urdf


def _edited(path: Path, joint: str) -> OutputError:
    return OutputError(
        f"joint {joint!r} is not placed as calibration.json says",
        where=str(path),
        remedy="One of the two files was edited: calibrate again.",
    )
