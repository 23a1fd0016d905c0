"""Opening a recording in the rerun viewer."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

from urdfcal.errors import OutputError
from urdfcal.output.results import RECORDING

if TYPE_CHECKING:
    from pathlib import Path


def open_recording(folder: Path) -> None:
    """Start the viewer on a result folder's recording and wait until it is closed.

    Raises:
        OutputError: there is no recording, or the viewer cannot open a window.
    """
    recording = folder / RECORDING if folder.is_dir() else folder
    if not recording.is_file():
        raise OutputError(
            "there is no recording here", where=str(folder), remedy="Name the folder that urdfcal calibrate -o wrote."
        )
    ended = subprocess.run([sys.executable, "-m", "rerun_cli", str(recording)], check=False)  # noqa: S603
    if ended.returncode != 0:
        raise OutputError(
            f"the rerun viewer stopped with code {ended.returncode}",
            where=str(recording),
            remedy="It needs a screen; the file can be copied to a machine that has one: rerun calibration.rrd",
        )
