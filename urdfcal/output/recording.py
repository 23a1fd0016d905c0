"""The rerun recording of a calibration, the folder of results that it is part of, and viewers, also of the solver."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from urdfcal import files
from urdfcal.errors import OutputError
from urdfcal.output.findings import Overview
from urdfcal.result.calibration import FILE_NAME

if TYPE_CHECKING:
    from rerun import RecordingStream

    from urdfcal.result.fitted import FittedCalibration

ROOT = "base"
"""Entity of the base link; all of a recording is in its frame."""
REPORT, RECORDING = "report.html", "calibration.rrd"
_LOOPBACK = "127.0.0.1"


def write_results(overview: Overview, folder: Path) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write corrected URDF, calibration.json, report and recording, all of them or nothing.

    Args:
        overview: of the result.
        folder: where to; made if need be. Results of an earlier run are replaced.

    Returns:
        The files written, and notes such as meshes that the recording could not find.

    Raises:
        OutputError: the folder cannot be written, or the corrected URDF fails its checks.
    """
    from urdfcal.output.report import write_report

    calibration = overview.calibration
    urdf = calibration.calibrated_urdf()
    with files.staged(folder) as stage:
        files.write_bytes(stage / calibration.urdf_name, urdf)
        calibration.save(stage / FILE_NAME)
        write_report(stage / REPORT, overview)
        notes = write_recording(stage / RECORDING, overview)
        names = sorted(path.name for path in stage.iterdir())
    return tuple(folder / name for name in names), notes


def write_recording(path: Path, overview: Overview) -> tuple[str, ...]:
    """Write a calibration as a rerun recording that brings its own layout of views.

    Args:
        path: the file, ``.rrd``; replaced in one step.
        overview: what to show.

    Returns:
        Warnings, such as meshes that were not found.

    Raises:
        OutputError: the file cannot be written.
    """
    import rerun as rr

    from urdfcal.output.blueprint import layout
    from urdfcal.output.entities import log_overview

    with files.replacing(path) as temporary:
        stream = rr.RecordingStream("urdfcal")
        try:
            stream.save(temporary, default_blueprint=layout(ROOT, overview))
            stream.send_recording_name(overview.calibration.chain.name)
            return log_overview(stream, overview, ROOT)
        finally:
            stream.disconnect()


def log_calibration(
    stream: RecordingStream, calibration: FittedCalibration, entity_path: str = ROOT
) -> tuple[str, ...]:
    """Log everything there is to see of a calibration into a rerun stream.

    Args:
        stream: the caller's recording.
        calibration: what to show.
        entity_path: where in it; the base link's frame.

    Returns:
        Warnings, such as meshes that were not found.
    """
    from urdfcal.output.entities import log_overview

    return log_overview(stream, Overview.of(calibration), entity_path)


class LiveView:
    """A viewer that shows the cost while the solver runs, and the whole calibration when it is done.

    Raises:
        OutputError: no viewer can be started.
    """

    def __init__(self, stream: RecordingStream | None = None) -> None:
        """Start a viewer, or send to a stream that is already watched."""
        import rerun as rr
        import rerun.blueprint as rrb

        from urdfcal.output.stream import ITERATION

        waiting = rrb.Blueprint(
            rrb.TimeSeriesView(origin="live", name="The solver at work: cost of every step"),
            rrb.TimePanel(timeline=ITERATION, state="collapsed"),
            collapse_panels=True,
        )
        self._steps = 0
        self._stream = stream or rr.RecordingStream("urdfcal")
        if stream is None:
            try:
                self._stream.spawn()
            except RuntimeError as error:
                raise OutputError(f"the rerun viewer does not start: {error}", remedy="Leave --live out.") from error
        self._stream.send_blueprint(waiting)
        self._stream.log("live/cost", rr.SeriesLines(names="cost"), static=True)

    def step(self, iteration: int, cost: float) -> None:
        """Show a step of the solver; several fits follow each other."""
        import rerun as rr

        from urdfcal.output.stream import ITERATION

        del iteration  # starts anew with every fit
        self._steps += 1
        self._stream.set_time(ITERATION, sequence=self._steps)
        self._stream.log("live/cost", rr.Scalars(cost))

    def finish(self, overview: Overview) -> None:
        """Show the result."""
        from urdfcal.output.blueprint import layout
        from urdfcal.output.entities import log_overview

        self._stream.reset_time()
        log_overview(self._stream, overview, ROOT)
        self._stream.send_blueprint(layout(ROOT, overview))
        self._stream.flush()


def find_recording(folder: Path) -> Path:
    """The recording of a result folder, or the file itself.

    Raises:
        OutputError: there is none.
    """
    recording = folder / RECORDING if folder.is_dir() else folder
    if not recording.is_file():
        raise OutputError(
            "there is no recording here", where=str(folder), remedy="Name the folder that urdfcal calibrate -o wrote."
        )
    return recording


def open_recording(recording: Path) -> None:
    """Start the viewer on a recording and wait until it is closed.

    Raises:
        OutputError: the viewer cannot open a window.
    """
    ended = subprocess.run([_rerun(), "--bind", _LOOPBACK, str(recording)], check=False).returncode  # noqa: S603
    if ended != 0:
        raise OutputError(
            f"the rerun viewer stopped with code {ended}",
            where=str(recording),
            remedy="It needs a screen; without one: urdfcal view --web, or --save and look at it elsewhere.",
        )


def serve_recording(recording: Path, port: int = 0) -> NoReturn:
    """Become a server of a recording as a web page, to this machine only; it prints the address.

    This process is replaced, so that whatever ends it ends the server.

    Args:
        recording: the file.
        port: of the page; 0 takes a free one.
    """
    sys.stdout.flush()
    ports = ["--port", "0", "--web-viewer-port", str(port)]
    os.execv(_rerun(), ["rerun", "--serve-web", "--bind", _LOOPBACK, *ports, str(recording)])  # noqa: S606


def _rerun() -> str:
    """The viewer itself; the command ``rerun`` is a wrapper that leaves it behind when ended."""
    from importlib.util import find_spec

    package = find_spec("rerun_cli")
    folder = Path(package.origin).parent if package is not None and package.origin else Path()
    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    if not (folder / name).is_file():
        raise OutputError("the rerun viewer is not installed", remedy="Install the package rerun-sdk.")
    return str(folder / name)
