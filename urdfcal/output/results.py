"""The folder of results: the corrected URDF, calibration.json, the recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

from urdfcal import files
from urdfcal.output.recording import write_recording

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.calibration import Calibration

JSON, RECORDING = "calibration.json", "calibration.rrd"


def write_results(calibration: Calibration, folder: Path) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write everything a calibration leaves behind, all of it or nothing.

    Args:
        calibration: the result.
        folder: where to; made if need be. Results of an earlier run are replaced.

    Returns:
        The files written, and notes such as meshes that the recording could not find.

    Raises:
        OutputError: the folder cannot be written, or the corrected URDF fails its checks.
    """
    urdf = calibration.calibrated_urdf()
    with files.staged(folder) as stage:
        files.write_bytes(stage / calibration.urdf_name, urdf)
        calibration.save(stage / JSON)
        notes = write_recording(stage / RECORDING, calibration)
        names = sorted(path.name for path in stage.iterdir())
    return tuple(folder / name for name in names), notes
