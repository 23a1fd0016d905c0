"""The folder of results: the corrected URDF, calibration.json, the report, the recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

from urdfcal import files
from urdfcal.output.overview import Overview
from urdfcal.output.recording import write_recording
from urdfcal.output.report import write_report
from urdfcal.result.calibration import FILE_NAME

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.pipeline import FittedCalibration

REPORT, RECORDING = "report.html", "calibration.rrd"


def write_results(
    calibration: FittedCalibration, folder: Path, overview: Overview | None = None
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write everything a calibration leaves behind, all of it or nothing.

    Args:
        calibration: the result.
        folder: where to; made if need be. Results of an earlier run are replaced.
        overview: ``Overview.of(calibration)``, if it is there already.

    Returns:
        The files written, and notes such as meshes that the recording could not find.

    Raises:
        OutputError: the folder cannot be written, or the corrected URDF fails its checks.
    """
    urdf = calibration.calibrated_urdf()
    overview = overview or Overview.of(calibration)
    with files.staged(folder) as stage:
        files.write_bytes(stage / calibration.urdf_name, urdf)
        calibration.save(stage / FILE_NAME)
        write_report(stage / REPORT, calibration, overview)
        notes = write_recording(stage / RECORDING, calibration, overview)
        names = sorted(path.name for path in stage.iterdir())
    return tuple(folder / name for name in names), notes
