"""The rerun recording of a calibration, the folder of results that it is part of, and a live view of the solver."""

from __future__ import annotations

from typing import TYPE_CHECKING

from urdfcal import files
from urdfcal.errors import OutputError
from urdfcal.output.findings import Overview
from urdfcal.result.calibration import FILE_NAME

if TYPE_CHECKING:
    from pathlib import Path

    from rerun import RecordingStream

    from urdfcal.result.fitted import FittedCalibration

ROOT = "base"
"""Entity of the base link; all of a recording is in its frame."""
REPORT, RECORDING = "report.html", "calibration.rrd"
REFUSED = "refused"
"""Folder, in that of the results, of the report on a calibration that failed its checks."""


def write_results(
    calibration: FittedCalibration, folder: Path, overview: Overview | None = None, *, pages: bool = True
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write corrected URDF, calibration.json, report and recording, all of them or nothing.

    Args:
        calibration: the result.
        folder: where to; made if need be. Results of an earlier run are replaced, and a report on a refused one goes.
        overview: ``Overview.of(calibration)``, if it is there already.
        pages: whether report and recording are written; those of an earlier run go in any case.

    Returns:
        The files written, and notes such as meshes that the recording could not find.

    Raises:
        OutputError: the folder cannot be written, or the corrected URDF fails its checks.
    """
    from urdfcal.output.report import write_report

    urdf = calibration.calibrated_urdf()
    notes: tuple[str, ...] = ()
    with files.staged(folder) as stage:
        files.write_bytes(stage / calibration.urdf_name, urdf)
        calibration.save(stage / FILE_NAME)
        if pages:
            overview = overview or Overview.of(calibration)
            write_report(stage / REPORT, calibration, overview)
            notes = write_recording(stage / RECORDING, calibration, overview)
        names = sorted(path.name for path in stage.iterdir())
    _forget_refused(folder)
    for name in () if pages else (REPORT, RECORDING):
        (folder / name).unlink(missing_ok=True)
    return tuple(folder / name for name in names), notes


def write_refused(calibration: FittedCalibration, folder: Path) -> Path:
    """Write the report on a calibration that is refused, apart from the results of an earlier one, and nothing else.

    Args:
        calibration: the result, which fails its assessment.
        folder: where results would go; made if need be.

    Returns:
        The report.

    Raises:
        OutputError: the folder cannot be written.
    """
    from urdfcal.output.report import write_report

    refused = folder / REFUSED
    with files.told(folder):
        folder.mkdir(exist_ok=True)
    with files.staged(refused) as stage:
        write_report(stage / REPORT, calibration, refused=True)
    return refused / REPORT


def _forget_refused(folder: Path) -> None:
    refused = folder / REFUSED
    with files.told(refused):
        (refused / REPORT).unlink(missing_ok=True)
        if refused.is_dir() and not any(refused.iterdir()):
            refused.rmdir()


def write_recording(path: Path, calibration: FittedCalibration, overview: Overview | None = None) -> tuple[str, ...]:
    """Write a calibration as a rerun recording that brings its own layout of views.

    Args:
        path: the file, ``.rrd``; replaced in one step.
        calibration: what to show.
        overview: ``Overview.of(calibration)``, if it is there already.

    Returns:
        Warnings, such as meshes that were not found.

    Raises:
        OutputError: the file cannot be written.
    """
    import rerun as rr

    from urdfcal.output.blueprint import layout

    overview = overview or Overview.of(calibration)
    with files.replacing(path) as temporary:
        stream = rr.RecordingStream("urdfcal")
        try:
            stream.save(temporary, default_blueprint=layout(ROOT, overview))
            stream.send_recording_name(calibration.session.chain.name)
            return log_overview(stream, overview)
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
    return log_overview(stream, Overview.of(calibration), entity_path)


def log_overview(stream: RecordingStream, overview: Overview, entity_path: str = ROOT) -> tuple[str, ...]:
    """Log what was worked out of a calibration; see :func:`log_calibration`."""
    import rerun as rr

    from urdfcal.output import arms, charts, entities, plots, texts
    from urdfcal.output.stream import Layer

    calibration, scene = overview.calibration, overview.scene
    session = calibration.session
    base = Layer(stream, entity_path, len(session.q))
    base.fixed(rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.TransformAxes3D(axis_length=0.1 * session.chain.reach))
    warnings = arms.log_arms(base, session, scene)
    arms.log_dh(base.at("dh"), calibration.table, scene)
    entities.log_cameras(base, calibration, scene)
    entities.log_leds(base, scene)
    entities.log_workspace(base.at("workspace"), overview.workspace)
    plots.log_residuals(base, scene)
    plots.log_convergence(base, calibration, scene)
    for chart in charts.all_charts(overview):
        plots.log_chart(base.at("charts"), chart)
    texts.log_texts(base, overview)
    return warnings


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

    def finish(self, calibration: FittedCalibration, overview: Overview | None = None) -> None:
        """Show the result."""
        from urdfcal.output.blueprint import layout

        overview = overview or Overview.of(calibration)
        self._stream.reset_time()
        log_overview(self._stream, overview)
        self._stream.send_blueprint(layout(ROOT, overview))
        self._stream.flush()
