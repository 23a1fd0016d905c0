"""The solver at work, in the viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from urdfcal.errors import OutputError
from urdfcal.output.stream import ITERATION

if TYPE_CHECKING:
    from rerun import RecordingStream

    from urdfcal.output.findings import Overview
    from urdfcal.pipeline import FittedCalibration


class LiveView:
    """A viewer that shows the cost while the solver runs, and the whole calibration when it is done.

    Raises:
        OutputError: no viewer can be started.
    """

    def __init__(self, stream: RecordingStream | None = None) -> None:
        """Start a viewer, or send to a stream that is already watched."""
        import rerun as rr
        import rerun.blueprint as rrb

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

        del iteration  # starts anew with every fit
        self._steps += 1
        self._stream.set_time(ITERATION, sequence=self._steps)
        self._stream.log("live/cost", rr.Scalars(cost))

    def finish(self, calibration: FittedCalibration, overview: Overview | None = None) -> None:
        """Show the result."""
        from urdfcal.output.blueprint import layout
        from urdfcal.output.findings import Overview
        from urdfcal.output.recording import ROOT, log_overview

        overview = overview or Overview.of(calibration)
        self._stream.reset_time()
        log_overview(self._stream, overview)
        self._stream.send_blueprint(layout(ROOT, overview))
        self._stream.flush()
