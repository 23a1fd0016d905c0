"""The rerun recording of a calibration: one file, one look, and one sees whether to trust it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from urdfcal.files import replacing
from urdfcal.output.overview import Overview

if TYPE_CHECKING:
    from pathlib import Path

    from rerun import RecordingStream

    from urdfcal.pipeline import FittedCalibration

ROOT = "base"
"""Entity of the base link; all of a recording stands in its frame."""


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
    with replacing(path) as temporary:
        stream = rr.RecordingStream("urdfcal")
        try:
            stream.save(temporary, default_blueprint=layout(ROOT, overview))
            stream.send_recording_name(calibration.session.chain.name)
            return log_calibration(stream, calibration, overview)
        finally:
            stream.disconnect()


def log_calibration(
    stream: RecordingStream, calibration: FittedCalibration, overview: Overview | None = None, path: str = ROOT
) -> tuple[str, ...]:
    """Log a calibration into a rerun stream, below an entity that stands for the base link.

    Args:
        stream: any rerun stream.
        calibration: what to show.
        overview: ``Overview.of(calibration)``, if it is there already.
        path: the entity.

    Returns:
        Warnings, such as meshes that were not found.
    """
    import rerun as rr

    from urdfcal.output import arms, charts, entities, plots
    from urdfcal.output.rows import row_offsets
    from urdfcal.output.stream import Layer

    overview = overview or Overview.of(calibration)
    session, scene = calibration.session, overview.scene
    base = Layer(stream, path, len(session.q))
    base.fixed(rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.TransformAxes3D(axis_length=0.1 * session.chain.reach))
    warnings = arms.log_arms(base, session, scene)
    arms.log_dh(base.at("dh"), calibration.table, row_offsets(calibration, calibration.estimate), scene)
    entities.log_cameras(base, calibration, scene)
    entities.log_leds(base, scene)
    entities.log_workspace(base.at("workspace"), overview.workspace)
    plots.log_residuals(base, scene)
    plots.log_convergence(base, calibration)
    for chart in charts.all_charts(overview):
        chart.log(base.at("charts"))
    entities.log_texts(base, overview)
    return warnings
