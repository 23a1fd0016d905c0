"""The rerun recording of a calibration: one file, one look, and one sees whether to trust it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from urdfcal.files import replacing
from urdfcal.output.scene import lay_out

if TYPE_CHECKING:
    from pathlib import Path

    from rerun import RecordingStream

    from urdfcal.calibration import Calibration
    from urdfcal.output.scene import Scene

ROOT = "base"
"""Entity of the base link; all of a recording stands in its frame."""


def write_recording(path: Path, calibration: Calibration) -> tuple[str, ...]:
    """Write a calibration as a rerun recording that brings its own layout of views.

    Args:
        path: the file, ``.rrd``; replaced in one step.
        calibration: what to show.

    Returns:
        Warnings, such as meshes that were not found.

    Raises:
        OutputError: the file cannot be written.
    """
    import rerun as rr

    from urdfcal.output.blueprint import layout

    scene = lay_out(calibration)
    with replacing(path) as temporary:
        stream = rr.RecordingStream("urdfcal")
        try:
            stream.save(temporary, default_blueprint=layout(ROOT, calibration, scene))
            stream.send_recording_name(calibration.session.chain.name)
            return log_calibration(stream, calibration, scene)
        finally:
            stream.disconnect()


def log_calibration(
    stream: RecordingStream, calibration: Calibration, scene: Scene | None = None, path: str = ROOT
) -> tuple[str, ...]:
    """Log a calibration into a rerun stream, below an entity that stands for the base link.

    Args:
        stream: any rerun stream.
        calibration: what to show.
        scene: ``lay_out(calibration)``, if it is there already.
        path: the entity.

    Returns:
        Warnings, such as meshes that were not found.
    """
    import rerun as rr

    from urdfcal.output import arms, entities, plots
    from urdfcal.output.stream import Layer

    scene = scene or lay_out(calibration)
    session, reach = calibration.session, calibration.session.chain.reach
    base = Layer(stream, path, len(session.q))
    base.fixed(rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.TransformAxes3D(axis_length=0.1 * reach))
    warnings = arms.log_arms(base, session, scene)
    arms.log_dh_frames(base.at("dh"), scene.dh, 0.08 * reach)
    for index in range(len(calibration.estimate.cameras)):
        entities.log_camera(base, index, calibration.estimate.cameras[index], scene)
    entities.log_leds(base, scene)
    plots.log_residuals(base, scene)
    plots.log_convergence(base, calibration)
    entities.log_about(base, scene, session.poses, session.led_names)
    return warnings
