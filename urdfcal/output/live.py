"""The solver at work in the rerun viewer, while a calibration runs."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from urdfcal.output.entities import log_overview
from urdfcal.output.recording import ROOT, layout
from urdfcal.output.stream import ITERATION
from urdfcal.output.viewer import Viewer

if TYPE_CHECKING:
    from rerun import RecordingStream

    from urdfcal.output.findings import Overview

# A clock that ticks twice a second tells a long computation from one that hangs.
_TICK = 0.5
# What a viewer that is slow, or just closed, is waited for at most. [s]
_PATIENCE = 20.0


class LiveView:
    """The cost of every fit of a calibration while it runs, and the whole calibration when it is done.

    Raises:
        OutputError: no viewer can be started.
    """

    def __init__(self, stream: RecordingStream | None = None) -> None:
        """Start a viewer, or send to a stream that is already watched."""
        self._viewer = Viewer.start() if stream is None else None
        self._stream = stream or rr.RecordingStream("urdfcal")
        if self._viewer is not None:
            self._stream.connect_grpc(self._viewer.address)
        self._stream.send_blueprint(
            rrb.Blueprint(
                rrb.Vertical(
                    rrb.TimeSeriesView(origin="live/cost", name="The solver at work: log10 of each fit's cost by step"),
                    rrb.TextDocumentView(origin="live/now", name="Now"),
                    row_shares=[5, 1],
                ),
                rrb.TimePanel(timeline=ITERATION, state="collapsed"),
                collapse_panels=True,
            )
        )
        self._fits = self._last = 0
        self._now, self._began = "preparing", time.monotonic()
        self._done = threading.Event()
        self._clock = threading.Thread(target=self._tick, daemon=True)
        self._clock.start()

    @property
    def watched(self) -> bool:
        """Whether the viewer is still open."""
        return self._viewer is None or self._viewer.open

    def step(self, iteration: int, cost: float) -> None:
        """Show a step of the solver; each fit is a curve of its own, which begins where numbers do not go on."""
        if iteration <= self._last or not self._fits:
            self._fits += 1
        self._last = iteration
        self.say(f"fit {self._fits}, step {iteration}, cost {cost:.4g}")
        if not self.watched or not cost > 0.0:
            return
        curve = f"live/cost/fit_{self._fits}"
        if iteration <= 1:
            self._stream.log(curve, rr.SeriesLines(names=f"fit {self._fits}"), static=True)
        self._stream.set_time(ITERATION, sequence=iteration)
        self._stream.log(curve, rr.Scalars(float(np.log10(cost))))

    def say(self, what: str) -> None:
        """Show what is being done; a clock counts how long already."""
        self._now, self._began = what, time.monotonic()

    def finish(self, overview: Overview) -> bool:
        """Show the result, and tell whether anyone still looks."""
        self.close()
        if not self.watched:
            return False
        self._stream.reset_time()
        log_overview(self._stream, overview, ROOT)
        self._stream.send_blueprint(layout(overview))
        self._stream.flush(timeout_sec=_PATIENCE)
        return self.watched

    def close(self) -> None:
        """Stop the clock; the viewer stays open."""
        self._done.set()
        self._clock.join()

    def _tick(self) -> None:
        while not self._done.is_set() and self.watched:
            text = f"{self._now}: {time.monotonic() - self._began:.0f} s"
            self._stream.log("live/now", rr.TextDocument(text), static=True)
            self._done.wait(_TICK)
